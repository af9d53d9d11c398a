"""Several teams in a gradient step: it learns the mean of what it would learn of each alone.

That the step is right for one team is shown in float64 by `test_race_update` and
`test_race_episodes`.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from frequencies import KEYS, assert_frequency
from test_race_update import (
    B,
    Frozen,
    float64,
    gradient_of,
    pevfa_loss,
    separate,
    targets_of,
    value_loss,
)
from test_structures import assert_slopes_equal
from tiny_episodes import SPEC, laid_out, random_batch, start, tiny_facmac

from race.algorithms import race
from race.algorithms.race_update import (
    draw_teams,
    of_all_agents,
    train_critics,
    train_policies,
)
from race.config.hyper import hyper_of
from race.config.presets import resolve
from race.config.settings import Config, RaceConfig
from race.config.shape import Shape, shape_of
from race.errors import ConfigError
from race.learners import learner_of
from race.networks.optimization import parameters
from race.types import EnvSpec

DRAWN = [3, 0, 2]
RATE = 0.5


def one_step(config: Config, spec: Any, state: Any, batch: Any) -> Callable[..., Any]:
    """Both halves of a gradient step with teams of the caller's choice, from the same networks."""
    shape, hyper = shape_of(config), hyper_of(config)

    @jax.jit
    def step(heads: Any) -> Any:
        policies = parameters(state.policies)
        samples = learner_of(shape).now(batch, spec)
        critics, losses, value = train_critics(
            *(state.critics, state.target, policies, batch, samples, of_all_agents(heads, spec)),
            *(jax.random.key(3), spec, shape, hyper),
        )
        trained, _, others, own = train_policies(
            *(state.policies, state.critics, state.target, samples, heads, value),
            *(jnp.int32(1), jax.random.key(4), spec, shape, hyper),
        )
        return (*critics, *trained), losses | others, own

    return step


def assert_close(got: Any, expected: Any) -> None:
    leaves = list(zip(*map(jax.tree.leaves, (got, expected)), strict=True))
    scale = max(np.abs(e).max() for _, e in leaves)
    assert scale > 1e-5
    for g, e in leaves:
        np.testing.assert_allclose(g, e, rtol=1e-3, atol=1e-4 * scale)


@pytest.mark.parametrize(
    ("base", "race_settings"),
    [
        ("episodes", {}),
        pytest.param("matd3", {}, marks=pytest.mark.slow),
        pytest.param("matd3", {"pevfa_target": "online"}, marks=pytest.mark.slow),
        pytest.param("matd3", {"one_pevfa": True}, marks=pytest.mark.slow),
        pytest.param("facmac", {}, marks=pytest.mark.slow),
        pytest.param("maddpg", {}, marks=pytest.mark.slow),
    ],
)
def test_a_step_is_the_mean_of_those_with_each_team_alone(
    tiny_spec: EnvSpec,
    tiny_config: Callable[..., Config],
    batch_of: Callable[..., Any],
    base: str,
    race_settings: dict[str, Any],
) -> None:
    race_settings = {"head_learning_rate": RATE, **race_settings}

    def config_of(count: int) -> Config:
        settings = {**race_settings, "teams_per_batch": count}
        if base == "episodes":
            return tiny_facmac(tiny_config, **settings)
        return tiny_config("race", base, race=settings)

    single, several = (config_of(count) for count in (1, len(DRAWN)))
    spec: Any = tiny_spec
    if base == "episodes":
        spec, state, batch = SPEC, start(single), laid_out(random_batch(), junk_seed=1).slots
    else:
        fresh = partial(race.init, spec=spec, shape=shape_of(single), hyper=hyper_of(single))
        state, batch = separate(jax.jit(fresh)(jax.random.key(11))), batch_of(spec, B)
    heads = state.heads[np.array(DRAWN)]
    alone = one_step(single, spec, state, batch)
    runs = [alone(head) for head in heads]
    together, losses, own = one_step(several, spec, state, batch)(heads)
    unlike = set()
    for name, loss in losses.items():
        found = np.array([float(run[1][name]) for run in runs])
        np.testing.assert_allclose(loss, found.mean(), rtol=1e-4)
        unlike |= {name} if found.std() > 1e-4 else set()
    assert {"pevfa", "vfm"} <= unlike <= {"pevfa", "vfm", "value"}
    for networks in zip(together, *(run[0] for run in runs), strict=True):
        if networks[0] is None:
            continue
        got, *found = (float64(gradient_of(network)) for network in networks)
        assert_close(got, jax.tree.map(lambda *leaves: np.mean(leaves, axis=0), *found))
    for got, head, (*_, climbed) in zip(own, heads, runs, strict=True):
        assert_close(got - head, climbed - head)  # a step of its own, as long as alone


def test_the_mean_of_the_losses_in_float64(
    tiny_spec: EnvSpec, tiny_config: Callable[..., Config], batch_of: Callable[..., Any]
) -> None:
    """Eqs. (1) and (4); of each team its own F(s)."""
    config = tiny_config("race", "maddpg", race={"teams_per_batch": len(DRAWN)})
    shape, hyper = shape_of(config), hyper_of(config)
    state = separate(
        jax.jit(lambda key: race.init(key, tiny_spec, shape, hyper))(jax.random.key(11))
    )
    batch, policies = batch_of(tiny_spec, B), parameters(state.policies)
    still = np.zeros((B, 3))
    f = Frozen(
        *(tiny_spec, float64(batch), float64(state.target), np.zeros(()), 1),
        *(config.learner.discount, (still, still)),
    )
    each = [f._replace(team=head) for head in float64(state.heads)[DRAWN]]
    # At the first sample the MARL team's target shall be between those of the teams.
    gap = np.mean([y_team[0] - y_marl[0] for y_marl, y_team in map(targets_of, each)]) / f.discount
    critic = eqx.tree_at(
        lambda c: c.out.bias, state.target.critic, replace_fn=lambda b: b + np.float32(gap)
    )
    state = state._replace(target=state.target._replace(critic=critic))
    each = [one._replace(target=float64(state.target)) for one in each]
    samples = learner_of(shape).now(batch, tiny_spec)
    after, losses, _ = jax.jit(
        lambda team: train_critics(
            *(state.critics, state.target, policies, batch, samples, team),
            *(jax.random.key(3), tiny_spec, shape, hyper),
        )
    )(state.heads[np.array(DRAWN)])
    y = [targets_of(one) for one in each]
    best = [np.maximum(*both) for both in y]
    assert {bool(y_team[0] > y_marl[0]) for y_marl, y_team in y} == {False, True}
    critics = float64(parameters(state.critics))

    def of_pevfa(pevfa: Any) -> float:
        pairs = zip(each, y, strict=True)
        return float(np.mean([pevfa_loss(pevfa, one, both[1]) for one, both in pairs]))

    def of_value(value: Any) -> float:
        return float(np.mean([value_loss(value, f, one) for one in best]))

    np.testing.assert_allclose(losses["pevfa"], of_pevfa(critics.pevfa), rtol=1e-4)
    np.testing.assert_allclose(losses["value"], of_value(critics.value), rtol=1e-4)
    assert_slopes_equal(of_pevfa, critics.pevfa, gradient_of(after.pevfa))
    assert_slopes_equal(of_value, critics.value, gradient_of(after.value))


@pytest.mark.parametrize("count", [2, 3, 6])
@pytest.mark.parametrize("team_draw", ["once", "each"])
def test_different_teams_are_drawn_all_alike(
    tiny_config: Callable[..., Config], team_draw: str, count: int
) -> None:
    choice = {"team_draw": team_draw, "marl_among_teams": True, "teams_per_batch": count}
    shape, n = shape_of(tiny_config("race", "matd3", race=choice)), 6
    heads = jnp.arange(5.0)[:, None, None, None] * jnp.ones((5, 2, 5, 2))
    marl_head = jnp.full((2, 5, 2), 5.0)
    drawn = jax.jit(jax.vmap(lambda key: draw_teams(heads, marl_head, key, shape)))(KEYS)
    first, second = (np.asarray(team.place) for team in drawn)
    for team, place in zip(drawn, (first, second), strict=True):
        assert place.shape == (len(KEYS), count)
        np.testing.assert_array_equal(np.asarray(team.heads)[:, :, 0, 0, 0], place)
        assert (np.diff(np.sort(place, axis=1), axis=1) > 0).all()
        for one in range(n):
            assert_frequency((place == one).any(axis=1).sum(), count / n, len(KEYS))
        for one in range(n):  # pairs too are all alike
            both = (place == one).any(axis=1) & (place == (one + 1) % n).any(axis=1)
            expected = count * (count - 1) / (n * (n - 1))
            assert_frequency(both.sum(), expected, len(KEYS))
    if team_draw == "once":
        np.testing.assert_array_equal(first, second)
    else:
        assert_frequency((first[:, 0] == second[:, 0]).sum(), 1 / n, len(KEYS))


def shape_with(**race: Any) -> Shape:
    return shape_of(resolve(Config("some-task", race=RaceConfig(**race))))


def test_no_more_teams_than_there_are() -> None:
    assert shape_with().teams_per_batch == 1
    assert shape_with(teams_per_batch=5).teams_per_batch == 5
    assert shape_with(teams_per_batch=6, marl_among_teams=True).teams_per_batch == 6
    assert shape_with(teams_per_batch=9, population_size=9).teams_per_batch == 9
    told = "from 1 to 5, the teams .* with --race.population-size 5, one more with --race.marl-amo"
    with pytest.raises(ConfigError, match=f"--race.teams-per-batch is 6, but it must be {told}"):
        shape_with(teams_per_batch=6)
    with pytest.raises(ConfigError, match=r"from 1 to 6, the teams .* 5\."):
        shape_with(teams_per_batch=7, marl_among_teams=True)
