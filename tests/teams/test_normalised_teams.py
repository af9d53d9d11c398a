"""Teams of runs that normalise act on what environments show, and so do their files."""

import contextlib
import re
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from tiny_teams import CONTINUOUS, DISCRETE, continuous, discrete, masks, trained_of

from race.envs.contract import in_units
from race.method.normalisation import CLIP, Observed, Running
from race.teams.export import export
from race.teams.portable import joint_action
from race.teams.team import Team

DOCS = Path(__file__).parents[2] / "docs"
EXAMPLES = re.findall(r"```python\n(.*?)```", (DOCS / "export.md").read_text(), re.DOTALL)
RNG = np.random.default_rng(5)


def seen(*shape: int) -> Running:
    """As if much had been seen, of means and spreads that differ by orders."""
    spread = 10.0 ** RNG.uniform(-2, 3, shape)
    return Running(np.asarray(1000.0), spread * RNG.normal(size=shape), 1000 * np.square(spread))


OF_STATE, OF_OBS = seen(4), seen(3, 5)


def shown(raw: np.ndarray, by: Running) -> np.ndarray:
    """What networks see, in float64."""
    spread = np.sqrt(by.squares / by.number + 1e-8)
    return np.clip((raw.astype(np.float64) - by.mean) / spread, -CLIP, CLIP)


def raw_like(by: Running, count: int, seed: int = 0) -> np.ndarray:
    """What an environment shows; the first entry lies far off now and then."""
    rng = np.random.default_rng(seed)
    x = by.mean + np.sqrt(by.squares / 1000) * rng.normal(size=(count, *by.mean.shape))
    x[::3].reshape(len(x[::3]), -1)[:, 0] += 1e6
    return x.astype(np.float32)


class World(gymnasium.Env[Any, Any]):
    """A few steps, for either kind of task."""

    action_space = gymnasium.spaces.Box(-10.0, 10.0, (3,), np.float32)

    def __init__(self, spec: Any) -> None:
        self._spec, self._steps = spec, 0

    def _seen(self) -> Any:
        if self._spec is CONTINUOUS:
            return raw_like(OF_STATE, 1, self._steps)[0]
        obs, state = raw_like(OF_OBS, 1, self._steps)[0], np.zeros(6, np.float32)
        return {"obs": obs, "state": state, "avail_actions": masks(1, self._steps)[0]}

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self._steps = 0
        return self._seen(), {}

    def step(self, action: Any) -> Any:
        self._steps += 1
        return self._seen(), 0.0, False, self._steps == 4, {}


def teams(form: str) -> tuple[Team, Team]:
    """A team that is shown things as they are, and the same of a run that normalises."""
    of_state = form in ("plain", "shared agents")
    spec: Any = CONTINUOUS if of_state else DISCRETE
    made = continuous(form) if of_state else discrete(form)
    trained = trained_of(*made, spec, lambda mode: World(spec))
    observed = Observed(None, OF_STATE) if of_state else Observed(OF_OBS, seen(6))
    return Team(trained, "marl"), Team(trained._replace(observed=observed), "marl")


@pytest.mark.parametrize("form", ["plain", "shared agents"])
def test_a_team_normalises_what_it_is_shown(form: str) -> None:
    plain, team = teams(form)
    states = raw_like(OF_STATE, 12)
    expected = plain.act(state=shown(states, OF_STATE))
    assert np.abs(np.diff(expected, axis=0)).max() > 0.1  # or nothing would be shown
    np.testing.assert_allclose(team.act(state=states), expected, atol=5e-5)
    each = [states[:, list(index)] for index in CONTINUOUS.obs_index]
    np.testing.assert_allclose(team.act(each), expected, atol=5e-5)
    # As the compiled program, which training and tests play with.
    low, high = (np.array(b, np.float32) for b in (CONTINUOUS.action_low, CONTINUOUS.action_high))
    policy = team.trained.policy("marl")
    units = np.stack([in_units(policy(state), low, high) for state in states])
    np.testing.assert_allclose(units, expected, atol=5e-5)
    for agent, action in enumerate(team.split(expected)):
        alone = team.agent(agent)
        found = joint_action(np, alone.arrays, alone.layer_norm, each[agent][:, None])
        np.testing.assert_allclose(found, action, atol=5e-5)


@pytest.mark.parametrize("form", ["one for all", "one each, normalised"])
def test_a_team_that_remembers_normalises(form: str) -> None:
    plain, team = teams(form)
    policy, said = team.trained.recurrent_policy("marl"), []
    for obs, available in zip(raw_like(OF_OBS, 12), masks(12), strict=True):
        said.append(team.act(obs, available))
        np.testing.assert_array_equal(said[-1], plain.act(shown(obs, OF_OBS), available))
        np.testing.assert_array_equal(said[-1], policy(obs, available))
    assert len({tuple(one) for one in np.array(said).tolist()}) > 3


CASES = [(f, s) for f in ("shared agents", "one for all") for s in ("onnx", "safetensors")]
CASES += [("plain", "stablehlo"), ("one for all", "stablehlo")]


@pytest.mark.parametrize(("form", "ending"), CASES)
def test_a_file_takes_what_environments_show(form: str, ending: str, tmp_path: Path) -> None:
    _, team = teams(form)
    (file,) = export(team, tmp_path / f"team.{ending}")
    assert file.difference < 1e-5
    assert "normalised inside" in file.card.read_text()
    obs, available = raw_like(OF_OBS, 4), masks(4)
    if form != "one for all":
        obs = raw_like(OF_STATE, 4)[:, CONTINUOUS.obs_gather]
    if ending == "stablehlo":
        return
    example = EXAMPLES[0].partition("\nteam = ")[0]
    numpy = ending == "safetensors"
    with contextlib.chdir(tmp_path):
        names: dict[str, Any] = {}
        exec("\n".join(EXAMPLES[1:3]) if numpy else example, names)
    stranger = None if numpy else names["Team"](str(file.path))
    if stranger is not None:
        stranger.reset(1)
    team.reset()
    memory = np.zeros((3, team.portable.memory_size), np.float32)
    for one, mask in zip(obs, available, strict=True):
        if form == "one for all":
            expected = team.act(one, mask)
            if numpy:
                found, memory = names["next_actions"](one, memory, mask)
            else:
                found = stranger.act(one, mask)[0]
            np.testing.assert_array_equal(found, expected)
        else:
            found = names["act"](one) if numpy else stranger.act(one)[0]
            np.testing.assert_allclose(found, team.act(one), atol=2e-5)
