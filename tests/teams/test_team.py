"""Teams act with numpy as their compiled programs do, in the environment's units."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_teams import (
    CONTINUOUS,
    DISCRETE,
    DISCRETE_FORMS,
    FORMS,
    continuous,
    discrete,
    masks,
    observations,
    trained_of,
)

from race.envs.contract import in_units
from race.errors import ConfigError, HandedOverError
from race.teams.portable import joint_action, next_actions
from race.teams.team import Team

LOW, HIGH = (np.array(b, np.float32) for b in (CONTINUOUS.action_low, CONTINUOUS.action_high))


@pytest.fixture(scope="module", params=FORMS)
def team(request: Any) -> Team:
    return Team(trained_of(*continuous(request.param), CONTINUOUS), "marl")


@pytest.fixture(scope="module", params=DISCRETE_FORMS)
def recurrent(request: Any) -> Team:
    return Team(trained_of(*discrete(request.param), DISCRETE), "marl")


def test_a_team_acts_as_its_compiled_program_does(team: Team) -> None:
    policy = team.trained.policy("marl")
    for seed in range(4):
        state = np.random.default_rng(seed).normal(size=4).astype(np.float32)
        expected = in_units(policy(state), LOW, HIGH)
        action = team.act(state=state)
        assert action.dtype == np.float32
        np.testing.assert_allclose(action, expected, atol=2e-6)
        assert (action >= LOW).all()
        assert (action <= HIGH).all()


def test_observations_in_any_form_are_the_same(team: Team) -> None:
    states = np.random.default_rng(7).normal(size=(3, 4)).astype(np.float32)
    together = team.act(state=states)
    each = [[state[list(agent)] for agent in CONTINUOUS.obs_index] for state in states]
    for row, obs, action in zip(states, each, together, strict=True):
        padded = np.full((2, 3), 1e9, np.float32)  # what is padding has no say
        for agent, own in enumerate(obs):
            padded[agent, : len(own)] = own
        for form in (obs, dict(zip("ab", obs, strict=True)), padded):
            np.testing.assert_allclose(team.act(form), action, atol=2e-6)
        np.testing.assert_allclose(team.act(state=row), action, atol=2e-6)
    batched = [np.stack([obs[agent] for obs in each]) for agent in range(2)]
    np.testing.assert_allclose(team.act(batched), together, atol=2e-6)


def test_agents_with_names_are_told_apart_by_them(team: Team) -> None:
    """Not by the order of a dictionary, which is the environment's affair."""
    facts = (("agent_names", ["left", "7"]), ("other_agents", ["rival"]))
    task = team.trained.task
    named = Team(team.trained._replace(task=task._replace(facts=facts)), "marl")
    assert (named.agent_names, team.agent_names) == (["left", "7"], None)
    state = np.random.default_rng(5).normal(size=4).astype(np.float32)
    left, right = (state[list(agent)] for agent in CONTINUOUS.obs_index)
    expected = team.act(state=state)
    for form in ({"left": left, 7: right}, {7: right, "rival": np.zeros(9), "left": left}):
        np.testing.assert_array_equal(named.act(form), expected)
    wrong: dict[Any, Any]
    for wrong, words in (
        ({"left": left}, "obs lacks 7: the agents of the team are left, 7"),
        ({"left": left, "rigth": right}, "obs lacks 7 and has rigth:"),
        ({"left": left, 7: right, "x": right}, "obs has x:"),
    ):
        with pytest.raises(HandedOverError, match=words):
            named.act(wrong)


def test_an_agent_alone_does_what_it_does_in_the_team(team: Team) -> None:
    state = np.random.default_rng(9).normal(size=4).astype(np.float32)
    for agent, own in enumerate(team.split(team.act(state=state))):
        alone = team.agent(agent)
        obs = state[list(CONTINUOUS.obs_index[agent])][None, None]
        action = joint_action(np, alone.arrays, alone.layer_norm, obs)[0]
        np.testing.assert_allclose(action, own, atol=2e-6)
    with pytest.raises(ConfigError, match="agents 0 to 1, not 2"):
        team.agent(2)


def test_a_team_remembers_as_its_compiled_program_does(recurrent: Team) -> None:
    policy = recurrent.trained.recurrent_policy("marl")
    recurrent.reset()
    obs, available = observations(DISCRETE, 12), masks(12)
    said = []
    for seen, mask in zip(obs, available, strict=True):
        action = recurrent.act(seen, mask)
        np.testing.assert_array_equal(action, policy(seen, mask))
        assert mask[np.arange(3), action].all()
        said.append(action)
    assert len({tuple(one) for one in np.array(said).tolist()}) > 3  # or nothing was shown
    recurrent.reset()
    np.testing.assert_array_equal(recurrent.act(obs[0], available[0]), said[0])


def test_a_batch_of_episodes_is_that_many_teams(recurrent: Team) -> None:
    obs, available = observations(DISCRETE, 8).reshape(4, 2, 3, 5), masks(8).reshape(4, 2, 3, 4)
    recurrent.reset()
    together = [recurrent.act(o, a) for o, a in zip(obs, available, strict=True)]
    for episode in range(2):
        recurrent.reset()
        alone = [recurrent.act(o[episode], a[episode]) for o, a in zip(obs, available, strict=True)]
        np.testing.assert_array_equal(alone, [action[episode] for action in together])
    with pytest.raises(HandedOverError, match="remembers 1 episodes and is shown 2"):
        recurrent.act(obs[0], available[0])


def test_an_agent_alone_remembers_for_itself(recurrent: Team) -> None:
    obs, available = observations(DISCRETE, 5), masks(5)
    recurrent.reset()
    together = [recurrent.act(o, a) for o, a in zip(obs, available, strict=True)]
    for agent in range(3):
        alone = recurrent.agent(agent)
        memory = np.zeros((1, 1, alone.memory_size), np.float32)
        for o, a, expected in zip(obs, available, together, strict=True):
            action, memory = next_actions(
                np, alone.arrays, alone.layer_norm, o[None, agent, None], memory, a[None, [agent]]
            )
            assert action.item() == expected[agent]


def test_what_no_environment_shows_is_refused(team: Team, recurrent: Team) -> None:
    nan = np.full((2, 3), np.nan)
    cases: list[tuple[Team, tuple[Any, ...], dict[str, Any], str]] = [
        (team, (), {}, "one of the two"),
        (team, (np.zeros((2, 3)),), {"state": np.zeros(4)}, "one of the two"),
        (team, (np.zeros(4),), {}, "Give it as state="),
        (team, (np.zeros((3, 3)),), {}, "the task says"),
        (team, ([np.zeros(3), np.zeros(3)],), {}, "obs of agent 1 has shape"),
        (team, (nan,), {}, "not finite"),
        (team, ([np.zeros(3), np.zeros(2), np.zeros(1)],), {}, "obs is no array of shape"),
        (recurrent, ([np.zeros(5), np.zeros(4)],), {}, "obs is no array of shape"),
        (recurrent, (np.zeros((3, 5)), [[1], [1, 1]]), {}, "avail_actions is no array of shape"),
        (team, ([["a"] * 3] * 2,), {}, "must be numbers"),
        (team, (np.zeros((2, 3)), np.ones((2, 3))), {}, "leave avail_actions out"),
        (recurrent, (), {"state": np.zeros(6)}, "give obs, not state"),
        (recurrent, (np.zeros((3, 5)), np.zeros((3, 4))), {}, "leaves an agent no action"),
        (recurrent, (np.zeros((3, 5)), np.full((3, 4), 2)), {}, "must be 1 and 0"),
        (recurrent, (np.zeros((3, 5)), np.ones((3, 3))), {}, "must be 1 and 0 of shape"),
    ]
    recurrent.reset()
    for who, obs, named, words in cases:
        with pytest.raises(HandedOverError, match=words):
            who.act(*obs, **named)


# The paper's sizes (Table 1). In a process of its own: here, every call's types are checked.
TIMED = """
import time
import jax, numpy as np
from tiny_teams import trained_of
from race.networks.dense import init_encoder, init_head
from race.teams.team import Team
from race.types import EnvSpec

halves, sizes = (tuple(range(6)), tuple(range(6, 12))), ((0, 1, 2), (3, 4, 5))
spec = EnvSpec("large", 12, halves, sizes, (-1.0,) * 6, (1.0,) * 6, 1000)
encoder = init_encoder(jax.random.key(0), spec, (400, 300), True)
team = Team(trained_of(encoder, init_head(jax.random.key(1), spec, 300), spec), "marl")
obs, times = np.zeros((2, 6), np.float32), []
for _ in range(3000):
    began = time.perf_counter()
    team.act(obs)
    times.append(time.perf_counter() - began)
print(sorted(times)[300])  # of the median a busy machine has its say
"""


@pytest.mark.slow
def test_one_action_takes_less_than_a_fifth_of_a_millisecond() -> None:
    done = subprocess.run(
        [sys.executable, "-c", TIMED],
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        check=True,
    )
    assert float(done.stdout) < 2e-4
