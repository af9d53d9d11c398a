"""Learners on probe tasks whose answer is known: what is learned, not only that something is.

Each learns from a fixed buffer of random actions, with the whole update of the algorithm.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from race import programs
from race.algorithms import algorithm_of
from race.config.hyper import hyper_of
from race.config.presets import resolve
from race.config.settings import Config, EnvConfig, LearnerConfig, RaceConfig
from race.config.shape import shape_of
from race.envs import make_task
from race.envs.probe import LAST, ChainEnv, TargetEnv
from race.learners import learner_of
from race.replay.buffer import init_replay
from race.rollouts.host import collect
from race.rollouts.pool import EnvPool
from race.rollouts.transitions import empty_transition, store
from race.training.run_state import statics
from race.types import Task, Transition

DISCOUNT = 0.8
BASES = ("matd3", "maddpg", "facmac")
# What MADDPG has of its own beside MATD3 is seen without a population.
PAIRS = [(algo, base) for base in BASES for algo in ("race", base)]


def methods(*slow: str) -> list[Any]:
    """All methods, of which those of RACE over some learners are not always tried."""
    return [
        pytest.param(*pair, marks=[pytest.mark.slow] * (pair[0] == "race" and pair[1] in slow))
        for pair in PAIRS
    ]


class Learned:
    """A trained algorithm, as functions of states and actions."""

    def __init__(self, algo: str, base: str, task: Task, data: Transition, steps: int) -> None:
        config = resolve(
            Config(
                task.spec.task,
                algo=algo,  # type: ignore[arg-type]
                base=base,  # type: ignore[arg-type]
                learner=LearnerConfig(
                    hidden_sizes=(32, 32),
                    batch_size=32,
                    actor_learning_rate=2e-3,
                    critic_learning_rate=3e-3,
                    discount=DISCOUNT,
                    target_update_rate=0.02,
                    smoothing_noise=0.05,
                ),
                race=RaceConfig(policy_embedding_size=8, mine_size=16, vmm_weight=1e-3),
            )
        )
        self.config, self.spec = config, task.spec
        self.algorithm, self.learner = algorithm_of(config), learner_of(shape_of(config))
        fixed = statics(config, task.spec, self.algorithm)
        state = programs.start(jax.random.key(0), hyper=hyper_of(config), **fixed)
        replay = store(init_replay(empty_transition(task.spec), max(len(data.reward), 2048)), data)
        sums = programs.empty_losses(self.algorithm)
        zero, count = np.int32(0), np.int32(steps)
        self.state, _ = programs.learn(
            jax.tree.map(jnp.copy, state),
            sums,
            replay,
            jax.random.key(1),
            zero,
            count,
            hyper=hyper_of(config),
            **fixed,
        )

    def teams(self) -> Any:
        return self.algorithm.teams(self.state, self.spec, shape_of(self.config))

    def act(self, states: np.ndarray) -> np.ndarray:
        """The MARL team's joint actions."""
        from race.networks.dense import act, encode

        teams = self.teams()
        encoder, heads = teams.encoder, teams.heads
        return np.asarray(
            act(encode(encoder, self.spec, jnp.asarray(states)), heads[-1], self.spec)
        )

    def q(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """The MARL critic, first of the ensemble."""
        critic = self.state.critics.critic if self.config.has_population else self.state.critic
        s, u = jnp.asarray(states), jnp.asarray(actions)
        return np.asarray(self.learner.q_marl(critic.params, s, u, self.spec)[0])

    def q_team(self, team: int, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """The PeVFA for a team of the population."""
        pevfa, head = self.state.critics.pevfa.params, self.state.heads[team]
        s, u = jnp.asarray(states), jnp.asarray(actions)
        return np.asarray(self.learner.q_team(pevfa, s, u, head, self.spec)[0])

    def v(self, states: np.ndarray) -> np.ndarray:
        """The state-value net."""
        value = self.state.critics.value.params
        return np.asarray(self.learner.state_values(value, jnp.asarray(states)))


def random_data(task: Task, steps: int) -> Transition:
    """Transitions of random actions."""
    rng = np.random.default_rng(0)
    parts, count = [], 0
    with EnvPool(task, 50, False) as pool:
        while count < steps:
            rollout = collect(
                pool,
                lambda states, tick: rng.uniform(
                    -1, 1, (len(states), task.spec.joint_action_size)
                ).astype(np.float32),
                rng.integers(0, 2**31, 50),
            )
            parts.append(rollout.transitions)
            count += len(rollout.transitions.reward)
    return Transition(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


Train = Callable[[str, str, str, int], tuple[Learned, Transition]]


@pytest.fixture(scope="module")
def train() -> Train:
    data: dict[str, tuple[Task, Transition]] = {}

    def make(algo: str, base: str, name: str, steps: int) -> tuple[Learned, Transition]:
        if name not in data:
            task = make_task(name, EnvConfig())
            data[name] = (task, random_data(task, 2000))
        task, transitions = data[name]
        return Learned(algo, base, task, transitions, steps), transitions

    return make


@pytest.mark.parametrize(("algo", "base"), methods("maddpg", "facmac"))
def test_agents_of_unequal_size_learn_functions_of_what_they_see(
    train: Train, algo: str, base: str
) -> None:
    learned, data = train(algo, base, "probe/target", 3000)
    states = np.asarray(data.state[:500])
    best = TargetEnv.optimal_action(states)
    error = np.square(learned.act(states) - best).sum(axis=1).mean()
    constant = np.square(best - best.mean(axis=0)).sum(axis=1).mean()
    assert error < 0.1 * constant
    true = -np.square(np.asarray(data.action[:500]) - best).sum(axis=1)
    assert np.abs(learned.q(states, np.asarray(data.action[:500])) - true).mean() < 0.2


@pytest.mark.parametrize(("algo", "base"), methods("maddpg", "facmac"))
def test_value_flows_back_discounted(train: Train, algo: str, base: str) -> None:
    learned, data = train(algo, base, "probe/chain", 3000)
    states, actions = np.asarray(data.state[:400]), np.asarray(data.action[:400])
    true = ChainEnv.optimal_q(states, actions, DISCOUNT)
    assert np.abs(learned.q(states, actions) - true).mean() < 0.1
    # The best first action is (1, 1), the best second one (0, 0).
    first, second = learned.act(np.array([[0, 0], [1, 0.3]], np.float32))
    assert first.min() > 0.9
    assert np.abs(second).max() < 0.15
    if algo == "race":
        # A team of the population is worth what its own actions bring.
        start = np.zeros((1, 2), np.float32)
        for team in range(5):
            head = learned.state.heads[team]
            ending = _team_action(learned, head, np.array([[1.0, 0.5]], np.float32))
            worth = DISCOUNT * (1.5 - np.square(ending).mean())
            estimate = learned.q_team(team, start, np.full((1, 2), 0.5, np.float32))[0]
            assert estimate == pytest.approx(worth, abs=0.15)


def _team_action(learned: Learned, head: Any, states: np.ndarray) -> np.ndarray:
    from race.networks.dense import act, encode

    encoder = learned.teams().encoder
    return np.asarray(act(encode(encoder, learned.spec, jnp.asarray(states)), head, learned.spec))


@pytest.mark.parametrize(("algo", "base"), methods("maddpg", "facmac"))
@pytest.mark.parametrize("task", ["probe/time-limit", "probe/terminates"])
def test_a_time_limit_bootstraps_and_a_termination_does_not(
    train: Train, algo: str, base: str, task: str
) -> None:
    learned, data = train(algo, base, task, 1500)
    states, actions = np.asarray(data.state[:200]), np.asarray(data.action[:200])
    if task == "probe/time-limit":
        true = np.full(200, 1 / (1 - DISCOUNT))
    else:
        true = (1 - DISCOUNT ** np.round(states[:, 0] * LAST)) / (1 - DISCOUNT)
    np.testing.assert_allclose(learned.q(states, actions), true, rtol=0.06, atol=0.1)
    if algo == "race":
        np.testing.assert_allclose(learned.v(states), true, rtol=0.06, atol=0.1)
        for team in range(5):
            np.testing.assert_allclose(
                learned.q_team(team, states, actions), true, rtol=0.06, atol=0.1
            )
