"""What holds for every algorithm over every learner."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from evolving import evolving
from tiny_episodes import with_heads

from race.algorithms import Algorithm, algorithm_of, ea, marl, merl, race
from race.algorithms.population import inject_team
from race.config.hyper import Hyper, hyper_of
from race.config.settings import Config, LearnerConfig
from race.config.shape import shape_of
from race.types import EnvSpec

ALGORITHMS = {"race": race, "marl": marl, "merl": merl, "no-sharing": merl, "ea": ea}
FAST = [
    *(("race", "matd3"), ("race", "facmac"), ("marl", "matd3")),
    *(("merl", "matd3"), ("ea", "matd3")),
]
SLOW = [
    *(("race", "maddpg"), ("marl", "maddpg"), ("marl", "facmac")),
    *(("merl", "maddpg"), ("merl", "facmac"), ("no-sharing", "matd3")),
]


class Case:
    """An algorithm over a learner, with a state of its own and its functions compiled."""

    def __init__(
        self,
        algorithm: Algorithm,
        spec: EnvSpec,
        config: Config,
        compiled: Callable[..., Any],
        batch_of: Callable[..., Any],
    ) -> None:
        self.algorithm, self.spec, self.config = algorithm, spec, config
        self.state = self.init(0)
        self.batch = batch_of(spec, 3)
        self.update = compiled(algorithm, "update", spec, config)
        # Evolution knows no learner: one program serves all.
        matd3 = dataclasses.replace(config, base="matd3", learner=LearnerConfig())
        self.evolve = compiled(algorithm, "evolve", spec, matd3)
        self.population = config.n_teams - config.n_marl_teams
        self.fitness = jnp.arange(max(1, self.population), dtype=jnp.float32)

    @property
    def static(self) -> dict[str, Any]:
        return {"spec": self.spec, "shape": shape_of(self.config)}

    def config_of(self, **learner: Any) -> Config:
        """The configuration with some of the learner's settings changed."""
        return dataclasses.replace(
            self.config, learner=dataclasses.replace(self.config.learner, **learner)
        )

    def inject(self, state: Any) -> Any:
        shape, hyper = shape_of(self.config), hyper_of(self.config)
        if self.algorithm.entrant is None:
            return state
        entrant = self.algorithm.entrant(state, shape)
        entered = inject_team(state.population, entrant, jax.random.key(0), hyper)
        return state._replace(population=entered)

    def heads(self, state: Any) -> Any:
        """Those of all teams."""
        return self.algorithm.teams(state, self.spec, shape_of(self.config)).heads

    def init(self, seed: int) -> Any:
        shape, hyper = shape_of(self.config), hyper_of(self.config)
        return self.algorithm.init(jax.random.key(seed), self.spec, shape, hyper)


@pytest.fixture(
    scope="module",
    params=[*FAST, *(pytest.param(names, marks=pytest.mark.slow) for names in SLOW)],
    ids="-".join,
)
def case(
    request: Any,
    tiny_spec: EnvSpec,
    tiny_config: Callable[..., Config],
    compiled: Callable[..., Any],
    batch_of: Callable[..., Any],
) -> Case:
    algo, base = request.param
    config = tiny_config(algo, base)
    return Case(ALGORITHMS[algo], tiny_spec, config, compiled, batch_of)


def assert_equal(one: Any, two: Any) -> None:
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        np.testing.assert_array_equal(a, b)


def same(one: Any, two: Any) -> bool:
    leaves = zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True)
    return all(np.array_equal(a, b) for a, b in leaves)


def networks(case: Case, state: Any) -> dict[str, Any]:
    """Critics, policies and targets of any algorithm's state."""
    if case.algorithm is race:
        return {"critics": state.critics, "policies": state.policies, "target": state.target}
    if case.algorithm is merl:
        state = state.marl
    return {
        "critics": state.critic,
        "policies": (state.encoder, state.head),
        "target": state.target,
    }


def test_configurations_name_their_algorithm(case: Case) -> None:
    assert algorithm_of(case.config) is case.algorithm


def test_functions_keep_structure_shapes_and_types(case: Case) -> None:
    """Also weak types: what differs between two calls would be compiled twice."""
    key, step = jax.random.key(0), jnp.int32(0)
    static = case.static | {"hyper": hyper_of(case.config)}
    before = jax.eval_shape(lambda s: s, case.state)
    updated, critic_losses, policy_losses = jax.eval_shape(
        partial(case.algorithm.update, **static), case.state, case.batch, step, key
    )
    evolved = jax.eval_shape(
        partial(evolving(case.algorithm), **static), case.state, case.fitness, key
    )
    injected = jax.eval_shape(case.inject, case.state)
    for after in (updated, evolved, injected):
        assert jax.tree.structure(after) == jax.tree.structure(before)
        for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(before), strict=True):
            assert (a.shape, a.dtype, a.weak_type) == (b.shape, b.dtype, b.weak_type)
    assert set(critic_losses) == set(case.algorithm.critic_losses)
    assert set(policy_losses) == set(case.algorithm.policy_losses)
    for loss in (*critic_losses.values(), *policy_losses.values()):
        assert (loss.shape, loss.dtype) == ((), jnp.float32)


def test_teams_champion_and_counts(case: Case) -> None:
    population = case.config.race.population_size if case.config.has_population else 0
    assert case.population == population
    heads = case.heads(case.state)
    h1 = case.config.learner.hidden_sizes[1] + 1
    count = population + case.config.has_marl
    assert heads.shape == (count, case.spec.n_agents, h1, case.spec.action_size)
    tested = {
        n: h for g in case.algorithm.tested(case.state, case.spec) for n, h in g.heads.items()
    }
    assert ("marl" in tested) == case.config.has_marl
    assert ("champion" in tested) == case.config.has_population
    assert all(team.shape == heads.shape[1:] for team in tested.values())
    assert (case.algorithm.population(case.state) is not None) == case.config.has_population


def test_fresh_targets_equal_the_networks_and_no_two_teams_are_alike(case: Case) -> None:
    heads = case.heads(case.state)
    assert len(np.unique(heads[:, 0, 0, 0])) == len(heads)
    if case.algorithm is ea:
        return
    state = case.state.marl if case.algorithm is merl else case.state
    trained = state.policies if case.algorithm is race else state
    assert_equal(state.target.encoder, trained.encoder.params)
    assert_equal(state.target.head, trained.head.params)
    critic = state.critics.critic if case.algorithm is race else state.critic
    assert_equal(state.target.critic, critic.params)
    if case.algorithm is race:
        assert_equal(state.target.pevfa, state.critics.pevfa.params)


def test_the_same_key_gives_the_same_and_another_key_another(case: Case) -> None:
    assert_equal(case.init(0), case.state)
    assert not same(case.init(1), case.state)
    one, two, other = (
        case.update(case.state, case.batch, jnp.int32(1), jax.random.key(k)) for k in (0, 0, 3)
    )
    assert_equal(one, two)
    if case.algorithm is race:
        assert not same(one, other)
    if case.config.has_population:
        a, b, c = (case.evolve(case.state, case.fitness, jax.random.key(k)) for k in (0, 0, 1))
        assert_equal(a, b)
        assert not same(a, c)


def test_policies_and_targets_wait_for_the_delay(case: Case) -> None:
    if not case.config.has_marl:
        pytest.skip("nothing is learned by gradients")
    delay = case.config.learner.policy_delay
    assert delay == (2 if case.config.base == "matd3" else 1)
    state = case.state
    for step in range(4):
        after, _, losses = case.update(state, case.batch, jnp.int32(step), jax.random.key(step))
        old, new = networks(case, state), networks(case, after)
        moves = (step + 1) % delay == 0
        assert not same(new["critics"], old["critics"])
        for name in ("policies", "target"):
            assert same(new[name], old[name]) != moves
        assert all(float(loss) == 0 for loss in losses.values()) != moves
        state = after


def test_a_step_traces_once(case: Case, batch_of: Callable[..., Any]) -> None:
    state = case.state
    sizes = []
    for step in range(6):
        state, *_ = case.update(
            state, batch_of(case.spec, 3, step), jnp.int32(step), jax.random.key(step)
        )
        if case.config.has_population and step % 2:
            state = case.inject(case.evolve(state, case.fitness, jax.random.key(step)))
        sizes.append(case.update._cache_size())
    assert sizes == sizes[:1] * 6


def test_seeds_are_a_leading_axis(case: Case, batch_of: Callable[..., Any]) -> None:
    states = [case.init(seed) for seed in (1, 2)]
    batches = [batch_of(case.spec, 3, seed) for seed in (1, 2)]
    keys = jax.random.split(jax.random.key(0))
    stacked, batch = (
        jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees) for trees in (states, batches)
    )
    # The runs differ in a number too.
    configs = [case.config, case.config_of(critic_learning_rate=3e-2, target_update_rate=0.3)]
    hyper = Hyper(*map(np.stack, zip(*map(hyper_of, configs), strict=True)))

    def update(state: Any, batch: Any, key: Any, hyper: Hyper) -> Any:
        return case.algorithm.update(state, batch, jnp.int32(1), key, hyper=hyper, **case.static)

    together = jax.jit(jax.vmap(update))(stacked, batch, keys, hyper)
    for seed in range(2):
        alone = jax.jit(update)(states[seed], batches[seed], keys[seed], hyper_of(configs[seed]))
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(a[seed], b, rtol=1e-4, atol=1e-6)

    fitness = jnp.stack([case.fitness, case.fitness[::-1]])
    evolve = partial(evolving(case.algorithm), hyper=hyper_of(case.config), **case.static)
    evolved = jax.jit(jax.vmap(evolve))(stacked, fitness, keys)
    evolved = jax.vmap(case.inject)(evolved)
    for seed in range(2):
        lone = case.inject(case.evolve(states[seed], fitness[seed], keys[seed]))
        for a, b in zip(jax.tree.leaves(evolved), jax.tree.leaves(lone), strict=True):
            np.testing.assert_allclose(a[seed], b, rtol=1e-6)


def with_junk_in_padding(case: Case) -> Any:
    """The state with large numbers wherever no observation or action entry is."""
    obs_rows = ~np.asarray(case.spec.obs_mask)
    columns = np.broadcast_to(~np.asarray(case.spec.action_mask)[:, None], (2, 5, 2))

    def spoil_encoder(encoder: Any) -> Any:
        weight = jnp.where(obs_rows[:, :, None], 1e3, encoder.hidden.weight)
        return dataclasses.replace(
            encoder, hidden=type(encoder.hidden)(weight, encoder.hidden.bias)
        )

    def spoil_critic(critic: Any) -> Any:
        """The factored critic alone has inputs that are padded."""
        if case.config.base != "facmac":
            return critic
        utilities = critic.utilities
        rows = np.concatenate([obs_rows, ~np.asarray(case.spec.action_mask)], axis=1)
        weight = jnp.where(rows[:, :, None], 1e3, utilities.first.weight)
        first = type(utilities.first)(weight, utilities.first.bias)
        spoiled = dataclasses.replace(utilities, first=first)
        return type(critic)(spoiled, critic.mixer)

    def spoil_pevfa(pevfa: Any) -> Any:
        if case.config.base != "facmac":
            return pevfa
        critic = spoil_critic(pevfa.critic)
        return type(pevfa)(critic, pevfa.embedding, pevfa.utility_weight, pevfa.mixer_weight)

    def spoil_head(head: Any) -> Any:
        return jnp.where(jnp.asarray(columns), 1e3, head)

    def spoil(trained: Any) -> Any:
        return trained._replace(
            encoder=trained.encoder._replace(params=spoil_encoder(trained.encoder.params)),
            head=trained.head._replace(params=spoil_head(trained.head.params)),
        )

    state = case.state
    target = state.target._replace(
        encoder=spoil_encoder(state.target.encoder),
        head=spoil_head(state.target.head),
        critic=spoil_critic(state.target.critic),
    )
    if case.algorithm is not race:
        critic = state.critic._replace(params=spoil_critic(state.critic.params))
        return spoil(state._replace(target=target, critic=critic))
    critics = state.critics._replace(
        critic=state.critics.critic._replace(params=spoil_critic(state.critics.critic.params)),
        pevfa=state.critics.pevfa._replace(params=spoil_pevfa(state.critics.pevfa.params)),
    )
    spoiled = state._replace(
        target=target._replace(pevfa=spoil_pevfa(target.pevfa)),
        critics=critics,
        policies=spoil(state.policies),
    )
    return with_heads(spoiled, jnp.where(jnp.asarray(columns)[None], 1e3, state.heads))


def test_padding_changes_no_loss_and_no_other_parameter(case: Case) -> None:
    if case.config.whole_teams:
        pytest.skip("the learner is that without a population")
    clean, *losses = case.update(case.state, case.batch, jnp.int32(1), jax.random.key(0))
    spoiled, *spoiled_losses = case.update(
        with_junk_in_padding(case), case.batch, jnp.int32(1), jax.random.key(0)
    )
    for a, b in zip(jax.tree.leaves(spoiled_losses), jax.tree.leaves(losses), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)
    for a, b in zip(jax.tree.leaves(spoiled), jax.tree.leaves(clean), strict=True):
        real = np.asarray(a) < 900
        np.testing.assert_allclose(np.asarray(a)[real], np.asarray(b)[real], rtol=1e-5, atol=1e-7)


def test_padded_columns_stay_zero(case: Case, batch_of: Callable[..., Any]) -> None:
    state = case.state
    for step in range(10):
        state, *_ = case.update(
            state, batch_of(case.spec, 3, step), jnp.int32(step), jax.random.key(step)
        )
        state = case.inject(case.evolve(state, case.fitness, jax.random.key(step)))
    heads = np.asarray(case.heads(state))
    padded = ~np.broadcast_to(np.asarray(case.spec.action_mask)[:, None], heads.shape)
    assert (heads[padded] == 0).all()
    assert (heads[~padded] != 0).all()


# --- what only RACE has -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def race_case(
    tiny_spec: EnvSpec,
    tiny_config: Callable[..., Config],
    compiled: Callable[..., Any],
    batch_of: Callable[..., Any],
) -> Case:
    return Case(race, tiny_spec, tiny_config("race", "matd3"), compiled, batch_of)


def test_all_teams_act_over_the_same_encoders_and_the_marl_team_is_last(race_case: Case) -> None:
    teams = race.teams(race_case.state, race_case.spec, shape_of(race_case.config))
    assert_equal(teams.encoder, race_case.state.policies.encoder.params)
    assert_equal(teams.heads[:-1], race_case.state.heads)
    assert_equal(teams.heads[-1], race_case.state.policies.head.params)


def test_evolution_touches_the_population_alone_and_never_its_elite(race_case: Case) -> None:
    state = race_case.state
    for seed in range(20):
        fitness = np.random.default_rng(seed).normal(size=5).astype(np.float32)
        after = race_case.evolve(state, jnp.asarray(fitness), jax.random.key(seed))
        elite = int(fitness.argmax())
        assert_equal(after.heads[elite], state.heads[elite])
        assert_equal(after.population.champion.heads, state.heads[elite])
        assert int(after.population.worst) == fitness.argmin()
        # Those that did not reproduce are gone, the worst of them too.
        for loser in np.argsort(fitness)[:3]:
            assert not np.array_equal(after.heads[loser], state.heads[loser])
        for name in ("policies", "critics", "target"):
            assert_equal(getattr(after, name), getattr(state, name))


@pytest.mark.parametrize("probability", [0.0, 1.0])
def test_the_next_population_is_elite_parent_copy_offspring_and_marl_team(
    race_case: Case, compiled: Callable[..., Any], probability: float
) -> None:
    state, config = race_case.state, race_case.config
    mutating = dataclasses.replace(config.race, mutation_probability=probability, elite_copy=True)
    evolve = compiled(race, "evolve", race_case.spec, dataclasses.replace(config, race=mutating))
    ranked = [3, 0, 2, 4, 1]  # all teams enter the tournament: the second is the parent
    fitness = jnp.zeros(5).at[jnp.array(ranked)].set(-jnp.arange(5.0))
    after = race_case.inject(evolve(state, fitness, jax.random.key(2)))
    elite, parent, copy, offspring, marl = (np.asarray(after.heads[team]) for team in ranked)
    np.testing.assert_array_equal(elite, state.heads[3])
    np.testing.assert_array_equal(marl, state.policies.head.params)
    assert int(after.population.injected) == 1
    if probability == 0:
        np.testing.assert_array_equal(parent, state.heads[0])
        np.testing.assert_array_equal(copy, elite)
        from_elite = (offspring == elite).all(axis=(1, 2))
        np.testing.assert_array_equal(from_elite, ~(offspring == parent).all(axis=(1, 2)))
        assert 0 < from_elite.sum() < 2
    else:
        assert not np.array_equal(copy, elite)  # open to mutation as any other
        # A mutant of the elite: where it changed it is of the elite's agents alone.
        np.testing.assert_array_equal(copy[:, -1], elite[:, -1])


def test_injection_replaces_the_worst_alone(race_case: Case) -> None:
    state = race_case.evolve(
        race_case.state, jnp.array([3.0, -1.0, 2.0, 5.0, 0.0]), jax.random.key(0)
    )
    after = race_case.inject(state)
    for team in range(5):
        expected = state.policies.head.params if team == 1 else state.heads[team]
        assert_equal(after.heads[team], expected)
    assert int(after.population.injected) == 1
    assert_equal(after.population.champion, state.population.champion)
    assert_equal(after.policies, state.policies)


def test_fates_of_the_injected_team(race_case: Case) -> None:
    """Scripted: where the injected team stands decides what is counted."""

    def counts(state: Any) -> list[int]:
        return np.asarray(state.population.injection_counts).tolist()

    def generation(state: Any, place_of_injected: int | None) -> Any:
        """Evolves on a fitness that ranks the injected team at this place, then injects."""
        others = [t for t in range(5) if t != int(state.population.injected)]
        if place_of_injected is not None:
            others.insert(place_of_injected, int(state.population.injected))
        fitness = np.zeros(5, np.float32)
        fitness[others] = -np.arange(5)
        evolved = race_case.evolve(
            state, jnp.asarray(fitness), jax.random.key(place_of_injected or 0)
        )
        assert int(evolved.population.elite) == others[0]
        return race_case.inject(evolved)

    state = race_case.state
    assert int(state.population.injected) == -1
    state = generation(state, None)
    assert counts(state) == [0, 0, 0]  # nobody had been injected yet
    script = [(0, [1, 0, 0]), (1, [1, 1, 0]), (2, [1, 1, 1]), (4, [1, 1, 2]), (0, [2, 1, 2])]
    for place, expected in script:
        state = generation(state, place)
        assert counts(state) == expected
    assert int(state.population.injected) != int(state.population.elite)


def test_evolution_survives_fitness_that_is_not_a_number(race_case: Case) -> None:
    state = race_case.evolve(race_case.state, jnp.full(5, jnp.nan), jax.random.key(0))
    assert int(state.population.elite) != int(state.population.worst)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state.heads))
    state = race_case.evolve(
        race_case.state, jnp.array([jnp.nan, -3.0, -jnp.inf, jnp.nan, -5.0]), jax.random.key(0)
    )
    assert int(state.population.elite) == 1
