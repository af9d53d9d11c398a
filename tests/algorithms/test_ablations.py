"""Ablations that are numbers: a gradient is zero where it should be, and elsewhere the full one.

Expected gradients are those of `test_race_update`: of each term of Eqs. (2) and (6) in float64.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from evolving import evolving
from test_race_update import (
    B,
    Frozen,
    assert_gradients_equal,
    drawn_team,
    float64,
    gradient_of,
    marl_loss,
    numeric_gradient,
    params,
    separate,
    signals,
    v_zeta,
    vfm_loss,
    vmm_loss,
)
from tiny_episodes import laid_out, random_batch, start, stepper, tiny_facmac

from race.algorithms import race
from race.algorithms.population import inject_team
from race.config.ablations import ABLATIONS, ablated, told_by_name
from race.config.hyper import Hyper, hyper_of
from race.config.presets import resolve
from race.config.saved import to_json
from race.config.settings import Config, RaceConfig
from race.config.shape import shape_of
from race.errors import ConfigError
from race.types import EnvSpec


class Terms(NamedTuple):
    """Gradients of the encoders' terms, in float64."""

    marl: Any  # -E[Q_psi]
    team: Any  # -E[Q_theta]
    vmm: Any  # Eq. (5)
    unweighted: Any  # Eq. (5) with all weights 1


class Case(NamedTuple):
    hyper: Hyper
    step: Callable[[Hyper], Any]  # -> state after, critic losses, policy losses
    full: Any
    terms: Terms


@pytest.fixture(scope="module")
def case(
    tiny_spec: EnvSpec, tiny_config: Callable[..., Config], batch_of: Callable[..., Any]
) -> Case:
    config = tiny_config("race", "matd3")
    shape, hyper, batch = shape_of(config), hyper_of(config), batch_of(tiny_spec, B)
    before = separate(race.init(jax.random.key(11), tiny_spec, shape, hyper))

    @jax.jit
    def step(hyper: Hyper) -> Any:
        return race.update(before, batch, jnp.int32(1), jax.random.key(5), tiny_spec, shape, hyper)

    full = step(hyper)
    zero = np.zeros((B, tiny_spec.joint_action_size))
    f = Frozen(
        tiny_spec, float64(batch), float64(before.target), np.zeros(()), 2, 0.99, (zero, zero)
    )
    f = f._replace(team=drawn_team(before, float(full[1]["pevfa"]), f))
    policies, critics = params(before.policies), params(full[0].critics)
    values = np.array([v_zeta(params(before.critics).value, s) for s in f.batch.state])
    agents = range(tiny_spec.n_agents)

    def marl(encoder: Any) -> float:
        return marl_loss(encoder, policies.head, critics.critic, f)

    def both(encoder: Any) -> float:
        return vfm_loss(encoder, policies.head, critics.critic, critics.pevfa, f)

    def vmm(encoder: Any) -> float:
        return sum(vmm_loss(encoder, policies.mine, values, f, agent) for agent in agents)

    def unweighted(encoder: Any) -> float:
        return -sum(
            float(np.mean(signals(encoder, policies.mine, f.spec, f.batch, agent)))
            for agent in agents
        )

    of_marl, of_both, of_vmm, of_unweighted = (
        numeric_gradient(loss, policies.encoder) for loss in (marl, both, vmm, unweighted)
    )
    of_team = jax.tree.map(np.subtract, of_both, of_marl)
    return Case(hyper, step, full, Terms(of_marl, of_team, of_vmm, of_unweighted))


def mixed(weights: tuple[float, float, float, float], terms: Terms) -> Any:
    return jax.tree.map(
        lambda *leaves: sum(w * x for w, x in zip(weights, leaves, strict=True)), *terms
    )


BETA = 0.3  # of the tiny configuration
ENCODERS = {
    "vfm-only": (1, 1, 0, 0),
    "vmm-only": (0, 0, BETA, 0),
    "vfm-marl-only": (1, 0, BETA, 0),
    "vfm-ea-only": (0, 1, BETA, 0),
    "unweighted-mi": (1, 1, 0, BETA),
}


@pytest.mark.parametrize("name", ENCODERS)
def test_encoders_descend_what_an_ablation_leaves(case: Case, name: str) -> None:
    changes = {k.split(".")[1]: np.float32(v) for k, v in ABLATIONS[name].settings.items()}
    after, *_ = case.step(case.hyper._replace(**changes))
    expected = mixed(ENCODERS[name], case.terms)
    assert_gradients_equal(gradient_of(after.policies.encoder), expected)
    only_encoders_differ(after, case.full[0])


def test_weights_in_between_mix(case: Case) -> None:
    numbers = {"vfm_marl_weight": 0.3, "vfm_team_weight": 2.0, "value_awareness": 0.6}
    hyper = case.hyper._replace(**{name: np.float32(x) for name, x in numbers.items()})
    after, *_ = case.step(hyper)
    expected = mixed((0.3, 2.0, 0.6 * BETA, 0.4 * BETA), case.terms)
    assert_gradients_equal(gradient_of(after.policies.encoder), expected)
    only_encoders_differ(after, case.full[0])


def only_encoders_differ(one: Any, other: Any) -> None:
    """All else is trained as in the whole method, to the bit."""
    for name in ("head", "mine"):
        assert_equal(getattr(one.policies, name), getattr(other.policies, name))
    assert_equal(one.critics, other.critics)
    assert_equal(one.target.head, other.target.head)


def assert_equal(one: Any, other: Any) -> None:
    for a, b in zip(*map(jax.tree.leaves, (one, other)), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_over_episodes_ablations_are_the_parts_of_the_whole(
    tiny_config: Callable[..., Config],
) -> None:
    """With equal draws, the encoder's gradient is the sum of what ablations leave of it."""
    config, batch = tiny_facmac(tiny_config), laid_out(random_batch(), None)

    def gradient(**changes: float) -> Any:
        changed = dataclasses.replace(config, race=dataclasses.replace(config.race, **changes))
        got = stepper(changed, race, fixed=True)(start(changed), batch)
        return jax.tree.map(np.asarray, gradient_of(got.after.policies.encoder)), got.after

    full, whole = gradient()
    none = {"vfm_marl_weight": 0.0, "vfm_team_weight": 0.0}
    parts = [
        gradient(**{**none, "vfm_marl_weight": 1.0, "vmm_weight": 0.0}),
        gradient(**{**none, "vfm_team_weight": 1.0, "vmm_weight": 0.0}),
        gradient(**none),
    ]
    together = jax.tree.map(lambda *leaves: sum(leaves), *(part for part, _ in parts))
    assert_gradients_equal(full, together)
    for part, after in parts:
        assert max(np.abs(leaf).max() for leaf in jax.tree.leaves(part)) > 1e-4
        only_encoders_differ(after, whole)


# --- evolution --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def evolved(
    tiny_spec: EnvSpec, tiny_config: Callable[..., Config]
) -> Callable[..., tuple[Any, Any]]:
    """(numbers) -> the state before and after a generation whose fittest are 3, then 0."""
    config = tiny_config("race", "matd3")
    shape, fitness = shape_of(config), jnp.array([4.0, 1.0, 3.0, 5.0, 2.0])
    state = race.init(jax.random.key(0), tiny_spec, shape, hyper_of(config))

    @jax.jit
    def generation(hyper: Hyper) -> Any:
        after = evolving(race)(state, fitness, jax.random.key(1), tiny_spec, shape, hyper)
        entered = inject_team(
            after.population, race.entrant(after, shape), jax.random.key(2), hyper
        )
        return after._replace(population=entered)

    def evolve(**changes: float) -> tuple[Any, Any]:
        numbers = {name: np.float32(value) for name, value in changes.items()}
        return state, generation(hyper_of(config)._replace(**numbers))

    return evolve


def test_without_crossover_and_mutation_teams_are_copies(
    evolved: Callable[..., tuple[Any, Any]],
) -> None:
    before, after = evolved(crossover_probability=0.0, mutation_probability=0.0)
    for team, source in ((3, 3), (0, 0), (2, 3), (4, 3)):
        np.testing.assert_array_equal(after.heads[team], before.heads[source])
    np.testing.assert_array_equal(after.heads[1], before.policies.head.params)


def test_without_injection_the_marl_team_never_enters(
    evolved: Callable[..., tuple[Any, Any]],
) -> None:
    before, after = evolved(injection_probability=0.0)
    _, injected = evolved()
    assert int(after.population.injected) == -1
    assert int(injected.population.injected) == 1
    np.testing.assert_array_equal(injected.heads[1], before.policies.head.params)
    assert not np.array_equal(after.heads[1], before.policies.head.params)
    np.testing.assert_array_equal(np.delete(after.heads, 1, 0), np.delete(injected.heads, 1, 0))


# --- names ------------------------------------------------------------------------------------


def test_names_are_settings() -> None:
    config = resolve(ablated(Config("probe/target"), ["vmm-only", "no-mutation"]))
    assert config.ablation == ("vmm-only", "no-mutation")
    assert (config.race.vfm_marl_weight, config.race.vfm_team_weight) == (0, 0)
    assert config.race.mutation_probability == 0
    assert told_by_name(config) == {
        "race.vfm_marl_weight",
        "race.vfm_team_weight",
        "race.mutation_probability",
    }
    assert ablated(Config("probe/target"), []) == Config("probe/target")
    for name, ablation in ABLATIONS.items():
        one = to_json(resolve(ablated(Config("probe/target"), [name])))
        for setting, value in ablation.settings.items():
            group, field = setting.split(".")
            assert one[group][field] == value != to_json(Config("probe/target"))[group][field]


@pytest.mark.parametrize(
    ("names", "why"),
    [
        (["vfm-only", "vmm-only"], "learn from nothing"),
        (["vfm-ea-only", "vfm-marl-only"], "together they are vmm-only"),
        (["vmm-only", "vfm-ea-only"], "neither term"),
        (["unweighted-mi", "vfm-only"], "no mutual information"),
        (["no-mutation", "no-crossover", "no-injection"], "not there at the start"),
        (["no-mutation", "no-mutation"], "twice"),
        (["parameter-mutation", "no-mutation"], "none of any kind"),
        (["parameter-crossover", "no-crossover"], "none of any kind"),
    ],
)
def test_nonsense_is_refused_with_a_reason(names: list[str], why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        ablated(Config("probe/target"), names)


def test_ablations_of_another_method_or_against_a_setting_are_refused() -> None:
    with pytest.raises(ConfigError, match="another method"):
        ablated(Config("probe/target", algo="matd3"), ["vfm-only"])
    with pytest.raises(ConfigError, match="all agents share an encoder anyway"):
        ablated(Config("probe/climb"), ["shared-agents"], discrete=True)
    one_head = Config("probe/climb", race=RaceConfig(team_heads="shared"))
    with pytest.raises(ConfigError, match="no other crossover"):
        ablated(one_head, ["parameter-crossover"], discrete=True)
    assert ablated(one_head, ["no-crossover"], discrete=True).race.crossover_probability == 0
    asked = Config("probe/target", race=RaceConfig(vmm_weight=0.1))
    with pytest.raises(ConfigError, match=r"--race\.vmm-weight to 0\.0, but it was set to 0\.1"):
        ablated(asked, ["vfm-only"])
    assert ablated(asked, ["no-mutation"]).race.vmm_weight == 0.1
    agreed = dataclasses.replace(asked, race=RaceConfig(vmm_weight=0.0))
    assert ablated(agreed, ["vfm-only"]).race == agreed.race
