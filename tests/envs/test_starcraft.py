"""StarCraft II behind SMAC, with stand-ins for both: what is asked, checked, told and ended."""

import ast
import contextlib
import dataclasses
import io
import json
import os
import pickle
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import fails, race

from race.config.presets import resolve
from race.config.settings import Config, EnvConfig
from race.envs import make_task, starcraft
from race.envs.checked import CheckedEnv
from race.envs.starcraft import game, remote, scenarios, telling
from race.errors import EnvFailedError, TaskError
from race.rollouts.discrete import EpisodeRollouts
from race.rollouts.pool import EnvPool
from race.types import DiscreteTask

STAND_IN = Path(__file__).parent / "stand_in"
ATTACK, STOP = 6, 1


@pytest.fixture
def sc2path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "StarCraftII"
    binary = folder / "Versions/Base75689/SC2_x64"
    binary.parent.mkdir(parents=True)
    binary.write_text("")
    binary.chmod(0o755)
    maps = folder / "Maps/SMAC_Maps"
    maps.mkdir(parents=True)
    for name in ("2s3z", "10gen_protoss"):
        (maps / f"{name}.SC2Map").write_text("")
    monkeypatch.setenv("SC2PATH", str(folder))
    return folder


@pytest.fixture
def python(tmp_path: Path, sc2path: Path) -> str:
    """An interpreter that has SMAC, which this one has not."""
    return written_python(tmp_path / "with smac", STAND_IN)


def written_python(folder: Path, path: Path, settings: str = "") -> str:
    folder.mkdir()
    file = folder / "python"
    file.write_text(f"#!/bin/sh\n{settings} PYTHONPATH='{path}' exec '{sys.executable}' \"$@\"\n")
    file.chmod(0o755)
    return str(file)


def task_of(name: str, python: str | None, **settings: Any) -> DiscreteTask:
    task = make_task(name, EnvConfig(python=python, **settings))
    assert isinstance(task, DiscreteTask)
    return task


@pytest.fixture
def env(python: str) -> Iterator[CheckedEnv]:
    made = CheckedEnv(task_of("smac/2s3z", python))
    yield made
    made.close()


def alive(process_id: int) -> bool:
    try:
        state = Path(f"/proc/{process_id}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def gone(process_ids: list[int], seconds: float = 15) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if not any(map(alive, process_ids)):
            return True
        time.sleep(0.05)
    return False


def processes_in(folder: Path) -> list[int]:
    """Those whose program lies in a folder."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            if str(folder) in path.read_bytes().decode(errors="replace"):
                found.append(int(path.parent.name))
    return found


def processes_of(seen: Any) -> list[int]:
    """The game and who speaks with it, as the stand-in's state tells."""
    return [int(seen.state[0]), int(seen.state[1])]


def test_sizes_masks_rewards_and_endings(env: CheckedEnv) -> None:
    spec = env.env.sizes
    assert (spec.n_agents, spec.n_actions, spec.obs_size, spec.state_size) == (2, 9, 3, 4)
    assert (spec.episode_limit, spec.has_wins) == (4, True)
    first: Any = env.reset(5)
    assert first.obs.tolist() == [[5, 1, 0], [6, 2, 1]]
    assert first.avail_actions.tolist() == [[False] + [True] * 8] * 2
    stop = np.full(2, STOP)
    steps: list[Any] = [env.step(stop) for _ in range(4)]
    assert [step.reward for step in steps] == [1, 2, 3, 4]
    assert [step.terminated for step in steps] == [False] * 3 + [True]  # as micro/* has it
    assert not any(step.truncated or step.won for step in steps)
    assert steps[0].seen.avail_actions[1].tolist() == [True] + [False] * 8  # it is dead
    assert steps[3].seen.obs[0].tolist() == [5, 1, 4]
    again: Any = env.reset(77)  # the seed is the game's, which goes on
    assert again.obs[0].tolist() == [5, 2, 0]
    assert again.state[0] == first.state[0]
    won = env.step(np.full(2, ATTACK))
    assert (won.reward, won.terminated, won.won) == (21, True, True)


def test_an_outer_limit_bootstraps(python: str) -> None:
    task = task_of("smac/2s3z", python, kwargs='{"continuing_episode": true}')
    env = CheckedEnv(task)
    try:
        env.reset(0)
        last = [env.step(np.full(2, STOP)) for _ in range(4)][-1]
    finally:
        env.close()
    assert (last.terminated, last.truncated) == (False, True)
    assert dict(task.facts)["env_kwargs"] == '{"continuing_episode": true}'


def test_teams_and_places_of_smacv2_are_drawn_by_the_seed(python: str) -> None:
    task = task_of("smacv2/protoss_3_vs_4", python)
    env = CheckedEnv(task)
    try:
        seeds = (1, 2, 1)
        drawn = [env.reset(seed).state.tolist() for seed in seeds]  # type: ignore[union-attr]
        state, obs, actions = starcraft.names(env.env)
    finally:
        env.close()
    assert drawn[0] == drawn[2]
    assert not set(drawn[0]) & set(drawn[1])
    assert len(set(drawn[0])) == 4  # generators differ from each other
    assert (state, obs[:2]) == (("a", "b", "c", "d"), ("3 against 4", "10gen_protoss"))
    assert actions[:2] == ("nothing (dead)", "stop")
    assert actions[-1] == "target 2"
    assert dict(task.facts)["scenario"] == "race's copy of the package's settings"


def test_scenarios() -> None:
    made = scenarios.settings("terran_10_vs_11")
    assert made is not None
    config = made["capability_config"]
    assert (config["n_units"], config["n_enemies"]) == (10, 11)
    assert config["team_gen"]["exception_unit_types"] == ["medivac"]
    for race_ in scenarios.RACES.values():
        assert np.isclose(sum(race_.weights), 1)
        assert len(race_.units) == len(race_.weights)
    assert all(scenarios.settings(name) for name in scenarios.NAMES)
    for name in ("terran_0_vs_5", "orc_5_vs_5", "protoss_5_vs_5_", "3m"):
        assert scenarios.settings(name) is None


def test_sentences_of_others_end_once() -> None:
    facts = {"text": "SC2 probably crashed. Check the error log.", "base": "/games"}
    told = [telling.refusal("smac/2s3z", "python", kind, facts) for kind in ("game", "arguments")]
    told += [telling.failure(kind, facts) for kind in ("error", "died")]
    for text in told:
        assert "error log" in text
        assert ".." not in text


def test_messages_arrive_as_they_were_sent(tmp_path: Path) -> None:
    arrays = {"obs": np.arange(6, dtype=np.float32).reshape(2, 3), "mask": np.zeros((0, 2), bool)}
    with (tmp_path / "pipe").open("w+b") as pipe:
        game.send(pipe, {"do": "step", "actions": [1, 2]}, arrays)
        game.send(pipe, {})
        pipe.seek(0)
        message, found = game.receive(pipe)
        assert message == {"do": "step", "actions": [1, 2]}
        for name, array in arrays.items():
            assert found[name].dtype == array.dtype
            np.testing.assert_array_equal(found[name], array)
        assert game.receive(pipe) == ({}, {})
        with pytest.raises(EOFError):
            game.receive(pipe)


def test_nothing_is_unpickled(tmp_path: Path) -> None:
    blob = io.BytesIO()
    np.lib.format.write_array(blob, np.array([{"a": 1}], object), allow_pickle=True)
    text = json.dumps({"message": {}, "arrays": {"obs": len(blob.getvalue())}}).encode()
    head = b"race" + struct.pack(">I", len(text))
    for sent, told in (
        (head + text + blob.getvalue(), "allow_pickle"),
        (pickle.dumps("something else"), "no message"),
        (b"race" + struct.pack(">I", 2**31), "no message"),
    ):
        (tmp_path / "pipe").write_bytes(sent)
        with (tmp_path / "pipe").open("rb") as pipe, pytest.raises(ValueError, match=told):
            game.receive(pipe)
    with (tmp_path / "pipe").open("wb") as pipe, pytest.raises(ValueError, match="allow_pickle"):
        game.send(pipe, {}, {"obs": np.array([None])})


def test_the_program_needs_python_3_8_numpy_and_nothing_of_ours() -> None:
    tree = ast.parse(Path(game.__file__).read_text(), feature_version=(3, 8))
    modules = {
        name.partition(".")[0]
        for node in ast.walk(tree)
        for name in (
            [alias.name for alias in node.names]
            if isinstance(node, ast.Import)
            else [str(node.module)]
            if isinstance(node, ast.ImportFrom)
            else []
        )
    }
    assert "race" not in modules
    assert modules - set(sys.stdlib_module_names) == {"numpy"}


@pytest.mark.parametrize("kind", ["dies", "exits"])
def test_a_game_that_dies_is_played_anew(
    kind: str,
    python: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    trouble = tmp_path / "trouble"
    trouble.write_text("")
    monkeypatch.setenv("STAND_IN_TROUBLE", str(trouble))
    stop = np.full(2, STOP)
    pool = EnvPool(task_of("smac/2s3z", python), 1, False, retries=2, proven=True)
    with pool:
        begun = pool.reset({0: 3})[0]
        before = processes_of(begun)
        trouble.write_text(kind)
        steps = [pool.step({0: stop})[0] for _ in range(2)]
        assert not isinstance(steps[0], EnvFailedError)
        failure = steps[1]
        assert isinstance(failure, EnvFailedError)
        assert "The game of smac/2s3z failed at step 2" in str(failure)
        told = "ConnectionError: websocket closed" if kind == "dies" else "exited with 7"
        assert told in str(failure)
        assert gone(before)
        pool.begin_again({0: failure}, 1)
        said = capsys.readouterr().err
        assert said.count("The episode is repeated in a fresh environment") == 1
        again: Any = pool.reset({0: 4})[0]
        assert again.obs[0].tolist() == [4, 1, 0]
        for _ in range(4):
            step: Any = pool.step({0: stop})[0]
        assert step.terminated
    assert gone(processes_of(again))


def test_games_run_side_by_side_and_end_with_their_pool(sc2path: Path, tmp_path: Path) -> None:
    # Processes of a pool have the environment of the time when the first of all was started.
    python = written_python(tmp_path / "with smac", STAND_IN, f"SC2PATH='{sc2path}'")
    task = task_of("smac/2s3z", python)
    config = resolve(Config("smac/2s3z", algo="facmac"), discrete=True)
    for asked, beside in ((None, True), (False, False)):
        env = dataclasses.replace(config.env, processes=asked)
        with EpisodeRollouts(dataclasses.replace(config, env=env), task) as rollouts:
            assert rollouts._host.pool.processes is beside
    with EnvPool(task, 2, True) as pool:
        found: Any = pool.reset({0: 1, 1: 2})
        running = [number for seen in found.values() for number in processes_of(seen)]
        assert len(set(running)) == 4
        assert all(map(alive, running))
    assert gone(running)


def test_no_game_outlives_who_started_it(python: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # A game that SMAC does not end, and a killed process that can end nothing.
    monkeypatch.setenv("STAND_IN", "leaves the game")
    script = (
        "import sys, time\n"
        "from race.envs.starcraft.remote import RemoteBattle, Wanted\n"
        f"battle = RemoteBattle(Wanted('smac', '2s3z', {{}}, None, {python!r}))\n"
        "battle.reset(0)\n"
        "print(*map(int, battle.get_state()[:2]), flush=True)\n"
        "time.sleep(600)\n"
    )
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE) as one:
        assert one.stdout is not None
        running = list(map(int, one.stdout.readline().split()))
        assert len(running) == 2
        assert all(map(alive, running))
        assert all(os.getpgid(number) == running[1] for number in running)
        # Ctrl-C goes to the group of the terminal, which is not theirs.
        assert os.getpgid(one.pid) != running[1]
        one.send_signal(signal.SIGKILL)
    assert gone(running)
    battle = remote.RemoteBattle(remote.Wanted("smac", "2s3z", {}, None, python))
    battle.reset(0)
    running = list(map(int, battle.get_state()[:2]))
    battle.close()
    battle.close()
    assert gone(running, 1)


def test_this_interpreter_without_another(sc2path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(STAND_IN))
    task = task_of("smac/2s3z", None)
    assert dict(task.facts)["game"] == "4.10.0 (build 75689)"
    other = task_of("smac/2s3z", None, kwargs='{"difficulty": "A"}')
    assert dict(other.facts)["env_kwargs"] == '{"difficulty": "A"}'


def test_commit_and_version_of_smac(tmp_path: Path, sc2path: Path) -> None:
    for name in ("smac", "pysc2", "absl"):
        (tmp_path / "code" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "code" / name).symlink_to(STAND_IN / name)
    notes = tmp_path / "code/SMAC-1.0.0.dist-info"
    notes.mkdir()
    (notes / "METADATA").write_text("Metadata-Version: 2.1\nName: SMAC\nVersion: 1.0.0\n")
    source = {"url": "there", "vcs_info": {"vcs": "git", "commit_id": "abc123"}}
    (notes / "direct_url.json").write_text(json.dumps(source))
    found = starcraft.look("smac", written_python(tmp_path / "bin", tmp_path / "code"))
    assert (found.wrong, found.facts["code"]) == ("", "1.0.0, commit abc123")
    notes.rename(tmp_path / notes.name)  # of another package, which is not the one that is found
    both = Path(f"{tmp_path / 'code'}{os.pathsep}{tmp_path}")
    found = starcraft.look("smac", written_python(tmp_path / "other", both))
    assert (found.wrong, found.facts["code"]) == ("", "of unknown version")


def test_what_is_missing_is_told_with_what_to_do(
    python: str, sc2path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(name: str = "smac/2s3z", python: str | None = python, **settings: Any) -> str:
        with pytest.raises(TaskError) as caught:
            task_of(name, python, **settings)
        return str(caught.value)

    assert "The nearest are smac/3s5z" in refused("smac/3s5y")
    assert "The nearest are smacv2/protoss_5_vs_5" in refused("smacv2/protos_5_vs_5")
    missing = refused("smac/8m")
    assert str(sc2path / "Maps/SMAC_Maps/8m.SC2Map") in missing
    assert "github.com/oxwhirl/smac" in missing
    assert "difficult" in refused(kwargs='{"difficult": "7"}')
    assert "map_name" in refused(kwargs='{"map_name": "8m"}')
    assert "Get StarCraft II 4.10" in refused(kwargs='{"game_version": "4.6.2"}')
    assert "/nowhere/python is no program that there is" in refused(python="/nowhere/python")
    assert "is it a Python" not in refused(python="/bin/false").lower()
    assert "exited with 1" in refused(python="/bin/false")
    assert "--env.python" in refused(python="/bin/echo")

    nothing = tmp_path / "nothing"
    nothing.mkdir()
    told = refused(python=written_python(tmp_path / "a", nothing))
    assert "SMAC is not installed" in told
    assert "pip install 'pysc2==4.0.0' 'protobuf<3.21'" in told
    (nothing / "smac").mkdir()
    (nothing / "smac/__init__.py").write_text("raise ImportError('an optimiser')")
    told = refused(python=written_python(tmp_path / "b", nothing))
    assert "another project of that name" in told
    assert "git+https://github.com/oxwhirl/smac.git" in told
    with monkeypatch.context() as other:
        other.setenv("STAND_IN", "protobuf")
        assert "needs protobuf 3.20" in refused()
    with monkeypatch.context() as other:
        other.setenv("SC2PATH", str(nothing))
        assert f"SC2PATH is {str(nothing)!r}, which has no folder Versions" in refused()
        other.delenv("SC2PATH")
        other.setenv("HOME", str(nothing))
        assert "SC2PATH is not set, and there is no game in" in refused()


def test_on_the_command_line(
    python: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "python").symlink_to(python)
    told = fails("train smac/2s4z --env.python ./python", capsys)
    assert "race train: There is no task 'smac/2s4z'. The nearest are smac/2s3z" in told
    assert not Path("runs").exists()
    told = fails("train probe/climb --algo facmac --env.python ./python", capsys)
    assert "--env.python would have no effect on probe/climb" in told
    race("describe smac/2s3z --env.python ./python")
    told = capsys.readouterr().out
    assert "game: 4.10.0 (build 75689)" in told
    assert "agent 0, agent 1" in told
    assert "attack" not in told  # the stand-in's sizes are not those of the map
    with pytest.raises(SystemExit):
        race("train smac/2s3z --help")
    told = capsys.readouterr().out
    assert "--env.python" in told
    assert "--env.agents" not in told
