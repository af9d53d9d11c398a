"""One gradient step of RACE over whole episodes, against its losses in float64.

The second version is `float64_episodes`, which cuts away what stands behind the end of an episode.
The minibatch that the package sees lies end to end, and is
full of junk where no step was made. The package's random draws are recorded
as they are made; its gradients are read off Adam's first moment after its first step.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from float64_episodes import (
    One,
    Sampled,
    critic_loss,
    episodes_of,
    float64,
    mean,
    min_max,
    pevfa_loss,
    policy_values,
    sampled,
    signals,
    signals_across,
    targets_of,
    v_zeta,
    value_loss,
)
from test_race_update import (
    assert_gradients_equal,
    gradient_of,
    numeric_gradient,
    params,
)
from tiny_episodes import (
    LENGTHS,
    TARGET_EVERY,
    A,
    Laid,
    groups_of,
    laid_out,
    random_batch,
    start,
    stepper,
    tiny_facmac,
)

from race.algorithms import marl, race
from race.algorithms.marl import MarlState
from race.algorithms.marl import Targets as MarlTargets
from race.config.settings import Config

CHOSEN: dict[str, Any] = {
    **{"utility_embedding": "agent", "vmm_reduction": "sum", "mine_negatives": "episodes"},
    "mine_embedding_layers": 2,
}


# Gradients are small here beside the heads, which a step of 1e3 of them does not lose in rounding.
@pytest.fixture(
    scope="module",
    params=[({"layer_norm": True}, 0.0), ({}, 0.0), (CHOSEN, 1e3)],
    ids=["normalised", "plain", "other choices"],
)
def config(request: Any, tiny_config: Callable[..., Config]) -> Config:
    choices, rate = request.param
    tiny = tiny_facmac(tiny_config, **choices)
    race = dataclasses.replace(tiny.race, head_learning_rate=rate)
    return dataclasses.replace(tiny, race=race)


class Explained(NamedTuple):
    """A gradient step with all that its losses hold fixed, in float64."""

    before: Any
    after: Any
    losses: dict[str, float]
    episodes: list[One]
    team: np.ndarray
    y_marl: list[np.ndarray]
    y_team: list[np.ndarray]
    marl_samples: Sampled
    team_samples: Sampled
    groups: list[list[tuple[int, int]]]  # none where MINE's negatives are of other episodes
    summed: bool  # over steps, in Eq. (5)

    def signals(self, mine: Any, encoder: Any) -> list[np.ndarray]:
        if not self.groups:
            return signals_across(mine, encoder, self.episodes)
        return signals(mine, encoder, self.episodes, self.groups)


def of_steps(batch: Laid, noise: np.ndarray) -> list[np.ndarray]:
    """What was drawn for the steps of each episode."""
    return batch.steps(noise.reshape(-1, *noise.shape[2:]).astype(float))


@pytest.fixture(scope="module")
def batch() -> Laid:
    return laid_out(random_batch(), junk_seed=1)


@pytest.fixture(scope="module")
def explained(config: Config, batch: Laid) -> Explained:
    """With the one team and the one order of draws that explain the losses."""
    got = stepper(config, race, fixed=False)(start(config), batch)
    episodes, hyper = episodes_of(random_batch()), config.facmac
    policies, target = params(got.before.policies), float64(got.before.target)
    pevfa = float64(got.before.critics.pevfa.params)
    fitting = []
    for team in float64(got.before.heads):
        y = targets_of(episodes, target, team, hyper.discount, hyper.td_lambda)
        if np.isclose(pevfa_loss(pevfa, team, episodes, y[1]), got.losses["pevfa"], rtol=1e-4):
            fitting.append((team, *y))
    ((team, y_marl, y_team),) = fitting
    critic = float64(got.after.critics.critic.params)
    # The same noise may be drawn more than once, where gradients go two ways.
    first, second = {noise.tobytes(): noise for noise in got.draws.noise}.values()
    orders = []
    for own, other in ((first, second), (second, first)):
        marl_s = sampled(policies.encoder, policies.head, episodes, of_steps(batch, own))
        value = policy_values(policies.encoder, policies.head, marl_s, episodes, critic)
        if np.isclose(-value, got.losses["policy"], rtol=1e-4):
            team_s = sampled(policies.encoder, team, episodes, of_steps(batch, other))
            orders.append((marl_s, team_s))
    ((marl_s, team_s),) = orders
    # MINE and the encoder learn from the same pairs.
    groups = []
    if config.race.mine_negatives == "steps":
        deal, again = got.draws.deals
        assert np.array_equal(deal, again)
        groups = groups_of(batch, deal)
        assert sorted(step for group in groups for step in group) == sorted(batch.where)
    else:
        assert not got.draws.deals
    summed = config.race.vmm_reduction == "sum"
    targets, samples = (y_marl, y_team), (marl_s, team_s)
    return Explained(
        got.before, got.after, got.losses, episodes, team, *targets, *samples, groups, summed
    )


def assert_loss(x: Explained, name: str, expected: float) -> None:
    assert abs(expected) > 1e-2
    np.testing.assert_allclose(x.losses[name], expected, rtol=1e-4)


def test_the_minibatch_has_what_it_should_show(explained: Explained) -> None:
    assert [one.length for one in explained.episodes] == list(LENGTHS)
    assert [one.terminated[-1] for one in explained.episodes] == [1, 0, 1, 1]
    # Either team has the better target somewhere, and samples differ from what was done.
    difference = np.concatenate(explained.y_marl) - np.concatenate(explained.y_team)
    assert difference.min() < 0 < difference.max()
    done = np.concatenate([one.taken for one in explained.episodes])
    for samples in (explained.marl_samples, explained.team_samples):
        assert not np.array_equal(np.concatenate(samples.hard), done)


def test_critics_descend_equation_1(explained: Explained) -> None:
    x = explained
    critics = params(x.before.critics)
    assert_loss(x, "critic", critic_loss(critics.critic, x.episodes, x.y_marl))
    assert_loss(x, "pevfa", pevfa_loss(critics.pevfa, x.team, x.episodes, x.y_team))
    assert_gradients_equal(
        gradient_of(x.after.critics.critic),
        numeric_gradient(lambda c: critic_loss(c, x.episodes, x.y_marl), critics.critic),
    )
    assert_gradients_equal(
        gradient_of(x.after.critics.pevfa),
        numeric_gradient(lambda p: pevfa_loss(p, x.team, x.episodes, x.y_team), critics.pevfa),
    )


def test_state_value_descends_equation_4(explained: Explained) -> None:
    x = explained
    best = [np.maximum(a, b) for a, b in zip(x.y_marl, x.y_team, strict=True)]
    value = params(x.before.critics).value
    assert_loss(x, "value", value_loss(value, x.episodes, best))
    assert_gradients_equal(
        gradient_of(x.after.critics.value),
        numeric_gradient(lambda v: value_loss(v, x.episodes, best), value),
    )


def marl_value(x: Explained, encoder: Any, head: np.ndarray) -> float:
    critic = float64(x.after.critics.critic.params)
    return policy_values(encoder, head, x.marl_samples, x.episodes, critic)


def vfm(x: Explained, encoder: Any, head: np.ndarray) -> float:
    """Eq. (2), with the critics that this step has just trained."""
    pevfa = float64(x.after.critics.pevfa.params)
    of_team = policy_values(encoder, x.team, x.team_samples, x.episodes, pevfa.critic, pevfa)
    return -(marl_value(x, encoder, head) + of_team)


def vmm(x: Explained, encoder: Any, mine: Any) -> float:
    """Eq. (5), with the values before the step of Eq. (4)."""
    value = params(x.before.critics).value
    weights = min_max([v_zeta(value, one.state[:-1]) for one in x.episodes])
    weighted = [w * signal for w, signal in zip(weights, x.signals(mine, encoder), strict=True)]
    return -float(np.mean([one.sum() for one in weighted])) if x.summed else -mean(weighted)


def test_the_encoder_descends_equation_6(explained: Explained, config: Config) -> None:
    x, beta = explained, config.race.vmm_weight
    assert beta is not None
    encoder, head, mine = params(x.before.policies)
    assert_loss(x, "vfm", vfm(x, encoder, head))
    assert_loss(x, "vmm", vmm(x, encoder, mine))
    assert_gradients_equal(
        gradient_of(x.after.policies.encoder),
        numeric_gradient(lambda e: vfm(x, e, head) + beta * vmm(x, e, mine), encoder),
    )


def test_the_marl_head_descends_equation_7_alone(explained: Explained) -> None:
    encoder, head, _ = params(explained.before.policies)
    assert head.shape == (1, 6, A)
    assert_loss(explained, "policy", -marl_value(explained, encoder, head))
    assert_gradients_equal(
        gradient_of(explained.after.policies.head),
        numeric_gradient(lambda h: -marl_value(explained, encoder, h), head),
    )


def test_mine_climbs_the_plain_bound_of_equation_3(explained: Explained) -> None:
    x = explained
    encoder, _, mine = params(x.before.policies)

    def loss(mine: Any) -> float:
        return -mean(x.signals(mine, encoder))

    assert_loss(x, "mine", loss(mine))
    assert_gradients_equal(gradient_of(x.after.policies.mine), numeric_gradient(loss, mine))


def test_nothing_is_learned_from_the_dead(explained: Explained) -> None:
    """Only dead agents do no-ops: what the encoder makes of a no-op before it is never trained."""
    assert all((one.action[one.available[:-1, :, 0]] == 0).all() for one in explained.episodes)
    gradient = gradient_of(explained.after.policies.encoder).last_action
    assert (gradient[0] == 0).all()
    assert (gradient[2:] != 0).any(axis=1).all()


def test_the_population_is_left_alone(explained: Explained, config: Config) -> None:
    """But for the team of Eq. (2), where it climbs its second term by its actions."""
    x, rate = explained, config.race.head_learning_rate
    new, old = np.asarray(x.after.heads), np.asarray(x.before.heads)
    (place,) = (p for p, head in enumerate(float64(old)) if np.array_equal(head, x.team))
    others = np.arange(len(old)) != place
    np.testing.assert_array_equal(new[others], old[others])
    if not rate:
        np.testing.assert_array_equal(new[place], old[place])
        return
    encoder, pevfa = params(x.before.policies).encoder, float64(x.after.critics.pevfa.params)

    def value(head: np.ndarray) -> float:
        samples, critic = x.team_samples, pevfa.critic
        return policy_values(encoder, head, samples, x.episodes, critic, pevfa, seen=x.team)

    assert_gradients_equal((new[place] - x.team) / rate, numeric_gradient(value, x.team))


def test_targets_become_copies(explained: Explained) -> None:
    before, after = explained.before, explained.after
    assert TARGET_EVERY == 2  # and this was the step of number 1
    assert not jnp.array_equal(before.target.head, after.target.head)
    trained = (*after.policies[:2], *after.critics[:2])
    for target, online in zip(after.target, trained, strict=True):
        for t, o in zip(*map(jax.tree.leaves, (target, online.params)), strict=True):
            np.testing.assert_array_equal(t, o)


def test_the_learner_alone_learns_from_its_critic(
    explained: Explained, config: Config, batch: Laid
) -> None:
    x, b = explained, explained.before
    alone = MarlState(
        b.policies.encoder,
        b.policies.head,
        b.critics.critic,
        MarlTargets(b.target.encoder, b.target.head, b.target.critic),
    )
    got = stepper(dataclasses.replace(config, algo="facmac"), marl, fixed=False)(alone, batch)
    assert_loss(x, "critic", got.losses["critic"])
    (noise,) = got.draws.noise
    encoder, head, _ = params(b.policies)
    critic = float64(got.after.critic.params)
    samples = sampled(encoder, head, x.episodes, of_steps(batch, noise))

    def loss(encoder: Any, head: np.ndarray) -> float:
        return -policy_values(encoder, head, samples, x.episodes, critic)

    np.testing.assert_allclose(got.losses["policy"], loss(encoder, head), rtol=1e-4)
    assert_gradients_equal(
        gradient_of(got.after.critic),
        numeric_gradient(lambda c: critic_loss(c, x.episodes, x.y_marl), params(b.critics).critic),
    )
    assert_gradients_equal(
        gradient_of(got.after.head), numeric_gradient(lambda h: loss(encoder, h), head)
    )
    assert_gradients_equal(
        gradient_of(got.after.encoder), numeric_gradient(lambda e: loss(e, head), encoder)
    )
