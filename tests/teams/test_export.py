"""Files of teams act as the teams do, in the hands of a stranger; else they are not written."""

import contextlib
import hashlib
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
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

from race.errors import ConfigError, ExportError
from race.teams import export as exporting
from race.teams.export import export, format_of
from race.teams.formats import written
from race.teams.team import Team

DOCS = Path(__file__).parents[2] / "docs"
EXAMPLES = re.findall(r"```python\n(.*?)```", (DOCS / "export.md").read_text(), re.DOTALL)


class World(gymnasium.Env[Any, Any]):
    """A few steps of chance, for either kind of task."""

    def __init__(self, spec: Any) -> None:
        self._spec, self._steps = spec, 0
        if spec is CONTINUOUS:
            low, high = (np.array(b, np.float32) for b in (spec.action_low, spec.action_high))
            self.action_space = gymnasium.spaces.Box(low, high)

    def _seen(self) -> Any:
        if self._spec is CONTINUOUS:
            return observations(self._spec, 1, self._steps)[0].ravel()[:4]
        return {
            "obs": observations(self._spec, 1, self._steps)[0],
            "state": np.zeros(6, np.float32),
            "avail_actions": masks(1, self._steps)[0],
        }

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self._steps = 0
        return self._seen(), {}

    def step(self, action: Any) -> Any:
        if self._spec is CONTINUOUS:
            assert self.action_space.contains(np.asarray(action))
        self._steps += 1
        return self._seen(), 0.0, False, self._steps == 4, {}


NAMES = ["left", "right"]


def team_of(form: str) -> Team:
    if form in FORMS:
        made, spec = continuous(form), CONTINUOUS
        trained = trained_of(*made, spec, lambda mode: World(spec))
        task = trained.task._replace(facts=(("agent_names", NAMES),))
        return Team(trained._replace(task=task), "marl")
    return Team(trained_of(*discrete(form), DISCRETE, lambda mode: World(DISCRETE)), "marl")


# Every form in the formats whose graphs are written by hand; JAX's own once of each kind.
CASES = [(f, s) for f in (*FORMS, *DISCRETE_FORMS) for s in ("onnx", "safetensors")]
CASES += [("shared agents", "stablehlo"), ("one each, normalised", "stablehlo")]


@pytest.mark.parametrize(("form", "ending"), CASES)
def test_a_file_acts_as_the_team_does(form: str, ending: str, tmp_path: Path) -> None:
    team, out = team_of(form), tmp_path / f"team.{ending}"
    (file,) = export(team, out)
    assert sorted(path.name for path in tmp_path.iterdir()) == [out.name, f"{out.name}.json"]
    assert 0 < file.difference < 1e-5 or ending == "safetensors"
    card = json.loads(file.card.read_text())
    assert card["sha256"] == hashlib.sha256(out.read_bytes()).hexdigest()
    assert card["checked"]["real_observations"] == 4
    assert card["agent_names"] == (NAMES if form in FORMS else None)
    assert card["inputs"]["obs"]["shape"] == ["batch", team.spec.n_agents, team.spec.obs_size]
    if form in FORMS:
        np.testing.assert_allclose(card["action_high"], CONTINUOUS.action_high)
        assert card["obs_of_state"] == [[2, 0, 3], [1, 3]]


@pytest.mark.parametrize("form", ["normalised", "one for all"])
def test_each_agent_has_a_file_of_its_own(form: str, tmp_path: Path) -> None:
    team = team_of(form)
    files = export(team, tmp_path / "team.onnx", per_agent=True)
    assert [file.path.name for file in files] == [
        f"team-agent{agent}.onnx" for agent in range(team.spec.n_agents)
    ]
    names = named(EXAMPLES[0].partition("\nteam = ")[0], tmp_path)
    obs, available = observations(team.spec, 1)[0], masks(1)[0]
    team.reset()
    discrete = form == "one for all"
    expected = team.split(team.act(obs, available) if discrete else team.act(obs))
    for agent, file in enumerate(files):
        alone = names["Team"](str(file.path))
        own = obs[agent, : alone.shapes["obs"][0]]
        action = alone.act(own, available[agent]) if discrete else alone.act(own)
        np.testing.assert_allclose(action[0], expected[agent], atol=1e-5)
        assert alone.card["agent"] == agent


def named(code: str, folder: Path) -> dict[str, Any]:
    """What some code of the documents defines."""
    names: dict[str, Any] = {}
    with contextlib.chdir(folder):
        exec(code, names)
    return names


@pytest.mark.parametrize("form", ["normalised", "one each, normalised"])
def test_onnxruntime_and_numpy_run_a_file_as_the_documents_say(form: str, tmp_path: Path) -> None:
    assert len(EXAMPLES[0].splitlines()) <= 34
    team = team_of(form)
    export(team, tmp_path / "team.onnx")
    # The last lines act once on zeros without a mask, which a team with discrete actions needs.
    stranger = named(EXAMPLES[0].partition("\nteam = ")[0], tmp_path)["Team"]
    there = stranger(str(tmp_path / "team.onnx"))
    obs, available = observations(team.spec, 6).reshape(3, 2, team.spec.n_agents, -1), masks(6)
    there.reset(2)
    team.reset()
    for seen, mask in zip(obs, available.reshape(3, 2, *available.shape[1:]), strict=True):
        if form in FORMS:
            np.testing.assert_allclose(there.act(seen), team.act(seen), atol=1e-5)
        else:
            np.testing.assert_array_equal(there.act(seen, mask), team.act(seen, mask))


@pytest.mark.parametrize("form", ["plain", "normalised"])
def test_numpy_runs_a_file_as_the_documents_say(form: str, tmp_path: Path) -> None:
    team = team_of(form)
    export(team, tmp_path / "team.safetensors")
    act = named(EXAMPLES[1], tmp_path)["act"]
    assert len(EXAMPLES[1].splitlines()) <= 26  # twenty without the empty ones
    for obs in observations(team.spec, 4):
        np.testing.assert_allclose(act(obs), team.act(obs), atol=1e-5)


@pytest.mark.parametrize("form", DISCRETE_FORMS)
def test_numpy_remembers_as_the_documents_say(form: str, tmp_path: Path) -> None:
    team = team_of(form)
    export(team, tmp_path / "team.safetensors")
    next_actions = named(EXAMPLES[1] + EXAMPLES[2], tmp_path)["next_actions"]
    memory = np.zeros((3, team.portable.memory_size))
    for obs, available in zip(observations(team.spec, 6), masks(6), strict=True):
        action, memory = next_actions(obs, memory, available)
        np.testing.assert_array_equal(action, team.act(obs, available))


@pytest.mark.parametrize("form", ["plain", "one for all"])
@pytest.mark.parametrize("ending", ["onnx", "safetensors"])
def test_a_file_of_another_team_is_refused(
    form: str, ending: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def changed(part: Any, *rest: Any) -> bytes:
        bias = part.arrays["head.bias"].copy()
        bias[0, 0] += 1.0 if form == "one for all" else 1e-4
        return written(part._replace(arrays=part.arrays | {"head.bias": bias}), *rest)

    monkeypatch.setattr(exporting, "written", changed)
    with pytest.raises(ExportError, match="would act otherwise"):
        export(team_of(form), tmp_path / f"team.{ending}")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("out", "kind", "words"),
    [
        ("team.txt", None, "does not say its format"),
        ("team.onnx", "numpy", "called as onnx is"),
        ("team", "tflite", "There is no format 'tflite'"),
    ],
)
def test_formats_that_are_not_meant(out: str, kind: str | None, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        format_of(Path(out), kind)
    assert format_of(Path("team.ONNX"), None) == "onnx"
    assert format_of(Path("team"), "numpy") == "numpy"


def test_what_is_missing_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ConfigError, match=r"pip install 'race-marl\[onnx\]'"):
        export(team_of("plain"), tmp_path / "team.onnx")
    (tmp_path / "file").write_text("")
    with pytest.raises(ExportError, match="cannot be written"):
        export(team_of("plain"), tmp_path / "file" / "team.safetensors")


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
def test_the_example_in_cpp_acts_as_the_team_does(form: str, tmp_path: Path) -> None:
    compiler = shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        pytest.skip("no C++ compiler")
    team, program = team_of(form), tmp_path / "act"
    export(team, tmp_path / "team.safetensors")
    flags = ["-O2", "-std=c++17", "-Wall", "-Werror"]
    source = str(DOCS / "examples" / "act.cpp")
    subprocess.run([compiler, *flags, source, "-o", str(program)], check=True)
    obs = observations(team.spec, 5)
    lines = "\n".join(" ".join(map(str, row.ravel().tolist())) for row in obs)
    done = subprocess.run(
        [str(program), str(tmp_path / "team.safetensors")],
        input=lines,
        capture_output=True,
        text=True,
        check=True,
    )
    found = np.array([[float(x) for x in line.split()] for line in done.stdout.splitlines()])
    np.testing.assert_allclose(found, team.act(obs), atol=1e-5)
    wrong = subprocess.run([str(program), "nothing"], capture_output=True, text=True, check=False)
    assert wrong.returncode == 1
    assert "cannot read nothing" in wrong.stderr
