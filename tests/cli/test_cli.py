"""The commands, with good and with bad input."""

import dataclasses
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import pytest
from commands import alone, fails, race
from PIL import Image
from whole_runs import rows

from race.cli import COMMANDS, streams
from race.config.settings import Config
from race.envs import task_ids
from race.runs import checkpoints, metrics
from race.runs import directory as run_directory
from race.viewing.progress import TrainingDisplay

SMALL = (
    "--env-steps 120 --learner.random-steps 40 --learner.hidden-sizes 12 8 --learner.batch-size 8 "
    "--race.policy-embedding-size 4 --race.mine-size 6 --evaluation.every 60 "
    "--evaluation.episodes 2"
)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("runs") / "race"
    race(f"train probe/terminates --run-dir {path} {SMALL}")
    return path


@pytest.fixture
def run(trained: Path, tmp_path: Path) -> Path:
    """A finished run that a test may damage."""
    return Path(shutil.copytree(trained, tmp_path / "run"))


def test_overview_and_unknown_commands(capsys: pytest.CaptureFixture[str]) -> None:
    race("--help")
    overview = capsys.readouterr().out
    assert all(name in overview for name in COMMANDS)
    race("--version")
    assert re.fullmatch(r"race \d+\.\d+\.\d+\n", capsys.readouterr().out)
    assert "Did you mean `race train`" in fails("trian", capsys)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        race(f"{command} --help")
    assert stopped.value.code == 0
    assert f"race {command}" in capsys.readouterr().out


def test_a_run_directory_holds_what_it_should(trained: Path) -> None:
    assert {"config.json", "metadata.json", "metrics.jsonl", "checkpoints", "DONE"} <= {
        path.name for path in trained.iterdir()
    }
    config = json.loads((trained / "config.json").read_text())
    assert (config["task"], config["algo"], config["env_steps"]) == (
        "probe/terminates",
        "race",
        120,
    )
    metadata = json.loads((trained / "metadata.json").read_text())
    assert "jax" in str(metadata)
    for row in metrics.read(trained / "metrics.jsonl"):
        assert {"kind", "env_steps", "gradient_steps", "generation", "wall_seconds"} <= set(row)


def test_presets_are_defaults_and_flags_win(tmp_path: Path) -> None:
    options = f"--preset td3 --algo maddpg --run-dir {tmp_path / 'a'} {alone(SMALL)}"
    race(f"train probe/terminates {options}")
    learner = json.loads((tmp_path / "a" / "config.json").read_text())["learner"]
    assert learner["actor_learning_rate"] == 3e-4  # from the preset
    assert learner["batch_size"] == 8  # from the flags
    assert learner["policy_delay"] == 1  # MADDPG's


def test_evaluate(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    results = {}
    for team in ("marl", "champion", "selected"):
        race(f"evaluate {trained} --team {team} --episodes 23 --seed 5 --json")
        results[team] = json.loads(capsys.readouterr().out)
        assert len(results[team]["returns"]) == 23
        assert results[team]["return_mean"] == pytest.approx(5.0)
    assert results["selected"]["played"] in ("marl", "champion")
    race(f"evaluate {trained} --episodes 3")
    assert "return over 3 episodes: 5" in capsys.readouterr().out


def test_resume_extends_a_finished_run(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "has finished" in fails(f"resume {run}", capsys)
    assert "would not extend" in fails(f"resume {run} --env-steps 100", capsys)
    before = metrics.read(run / "metrics.jsonl")
    race(f"resume {run} --env-steps 200")
    after = metrics.read(run / "metrics.jsonl")
    assert after[: len(before)] == before
    assert after[-1]["env_steps"] >= 200
    assert json.loads((run / "config.json").read_text())["env_steps"] == 200
    assert (run / "DONE").exists()


def test_a_failed_extension_changes_nothing(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    newest = checkpoints.newest(run / "checkpoints")
    assert newest is not None
    before = (run / "config.json").read_text()
    (newest / "manifest.json").write_text("{}")
    assert newest.name in fails(f"resume {run} --env-steps 500", capsys)
    assert (run / "config.json").read_text() == before
    assert (run / "DONE").exists()
    # The advice of the message works.
    shutil.rmtree(newest)
    race(f"resume {run} --env-steps 150")
    assert json.loads((run / "config.json").read_text())["env_steps"] == 150
    assert metrics.read(run / "metrics.jsonl")[-1]["env_steps"] >= 150


def test_a_run_with_damaged_metrics_stays_as_it_is(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truncate(run / "metrics.jsonl")
    before = (run / "config.json").read_text()
    assert "metrics.jsonl" in fails(f"resume {run} --env-steps 500", capsys)
    assert (run / "DONE").exists()
    assert (run / "config.json").read_text() == before


def test_a_budget_below_what_was_done_is_refused(
    trained: Path, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (run / "DONE").unlink()  # as if killed just before it was written
    assert "would not extend" in fails(f"resume {run} --env-steps 50", capsys)
    race(f"resume {run}")
    assert (run / "DONE").exists()
    assert (run / "metrics.jsonl").read_bytes() == (trained / "metrics.jsonl").read_bytes()


def test_a_locked_run_is_left_alone(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (run / "config.json").read_text()
    with run_directory.lock(run):
        assert str(os.getpid()) in fails(f"resume {run} --env-steps 500", capsys)
    assert (run / "config.json").read_text() == before


def test_ctrl_c_saves_and_says_how_to_go_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = tmp_path / "whole"
    race(f"train probe/terminates --run-dir {whole} {SMALL}")
    path = tmp_path / "run"
    calls = 0
    real = TrainingDisplay.report

    def interrupted(self: TrainingDisplay, *news: Any) -> None:
        nonlocal calls
        calls += 1
        if calls == 9:
            os.kill(os.getpid(), signal.SIGINT)
        real(self, *news)

    monkeypatch.setattr(TrainingDisplay, "report", interrupted)
    with pytest.raises(SystemExit) as stopped:
        race(f"train probe/terminates --run-dir {path} {SMALL}")
    assert stopped.value.code == 130
    assert f"race resume {path}" in " ".join(capsys.readouterr().out.split())
    assert not (path / "DONE").exists()
    race(f"resume {path}")

    def rows(of: Path) -> list[dict[str, Any]]:
        timeless = re.compile("wall_seconds|time/.*|run$")
        found = metrics.read(of / "metrics.jsonl")
        return [{k: v for k, v in row.items() if not timeless.match(k)} for row in found]

    assert rows(path) == rows(whole)


def test_every_setting_is_an_option(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        race("train --help-all")
    text = capsys.readouterr().out
    assert "None}" not in text
    groups = {
        f.name: f.default_factory()
        for f in dataclasses.fields(Config)  # type: ignore[misc]
        if f.default_factory is not dataclasses.MISSING
    }
    for group, settings in groups.items():
        for setting in dataclasses.fields(settings):
            assert f"--{group}.{setting.name}".replace("_", "-") in text


def helped(command: str, capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as stopped:
        race(command)
    assert stopped.value.code == 0
    return capsys.readouterr().out


def test_help_is_short_at_first(capsys: pytest.CaptureFixture[str]) -> None:
    text = helped("train --help", capsys)
    assert len(text.splitlines()) < 100
    places = [text.index(f"  {flag}") for flag in ("TASK", "--algo", "--env-steps INT", "--base")]
    assert places == sorted(places)
    assert "--learner.* " in text
    assert "--learner.discount" not in text
    assert "[1_000_000]" in text


@pytest.mark.parametrize(
    ("asked", "shown", "hidden"),
    [
        ("mamujoco/Ant-4x2", "learner.policy-delay env.agent-obsk", "facmac.discount env.agents"),
        ("mamujoco/Ant-4x2 --algo matd3", "learner.discount", "race.population-size"),
        ("micro/2s3z", "facmac.discount race.elite-copy", "learner.discount env.retries"),
        ("probe/matching --algo facmac", "facmac.mixer-size", "race.sharing env.kwargs"),
        ("pettingzoo:mpe2.simple_v3", "env.agents facmac.td-lambda", "learner.tau env.agent-obsk"),
        ("probe/chain --env-steps x", "learner.discount", "facmac.discount"),
    ],
)
def test_help_of_a_task_shows_what_it_has(
    asked: str, shown: str, hidden: str, capsys: pytest.CaptureFixture[str]
) -> None:
    text = helped(f"train {asked} --help", capsys)
    assert all(f"  --{name}" in text for name in shown.split())
    assert not any(f"  --{name}" in text for name in hidden.split())
    assert f"usage: race train {asked.split()[0]} " in text


def test_help_tells_defaults_of_the_preset(capsys: pytest.CaptureFixture[str]) -> None:
    text = helped("train probe/chain --preset demo -h", capsys)
    assert re.search(r"--learner.hidden-sizes INT INT [^-]*\[160 120\]", text)
    assert "--learner.layer-norm, --learner.no-layer-norm" in text
    assert "no task 'probe/chian'" in fails("train probe/chian --help", capsys)


def test_observations_are_settings(tmp_path: Path) -> None:
    sees = "--env.agent-obsk 1 --env.local-categories qpos,qvel qpos --env.global-categories qvel"
    race(f"train mamujoco/Hopper-3x1 {sees} --run-dir {tmp_path / 'run'} {SMALL}")
    saved = json.loads((tmp_path / "run" / "config.json").read_text())["env"]
    assert saved["local_categories"] == [["qpos", "qvel"], ["qpos"]]
    assert saved["global_categories"] == ["qvel"]


def test_list(capsys: pytest.CaptureFixture[str]) -> None:
    race("list --json")
    listing = json.loads(capsys.readouterr().out)
    tasks = {task["id"]: task for task in listing["tasks"]}
    assert (tasks["mamujoco/Ant-2x4d"]["alpha"], tasks["mamujoco/Ant-2x4d"]["beta"]) == (0.2, 1e-2)
    assert sum(task["paper_name"] is not None for task in tasks.values()) == 16
    battle = tasks["micro/MMM2"]
    sizes = ("agents", "enemies", "actions", "obs", "state", "limit", "alpha", "beta")
    assert [battle[size] for size in sizes] == [10, 12, 18, 176, 322, 180, 0.01, 1e-2]
    assert set(listing["algorithms"]) == {"race", "merl", "ea", "matd3", "maddpg", "facmac"}
    assert "vmm-only" in listing["ablations"]
    race("list")
    lines = capsys.readouterr().out.splitlines()  # nobody reads at a terminal
    found = {line.split("\t")[0]: line.split("\t")[1:] for line in lines}
    assert set(tasks) < set(found)
    assert found["mamujoco/Ant-4x2"][:3] == ["4-Agent Ant", "0.2", "0.001"]
    assert found["--ablation no-injection"] == ["the MARL team never enters the population"]
    assert "pettingzoo:MODULE.ENV" in found
    assert len(found) == len(lines)


def test_list_at_a_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(streams, "is_terminal", lambda: True)
    monkeypatch.setenv("COLUMNS", "80")
    race("list")
    lines = capsys.readouterr().out.splitlines()
    (ant,) = [line for line in lines if line.startswith("mamujoco/Ant-4x2 ")]
    assert ant.split()[:5] == ["mamujoco/Ant-4x2", "4-Agent", "Ant", "0.2", "0.001"]
    assert all(len(line) <= 80 for line in lines)
    assert [line.split()[0] for line in lines[1 : len(task_ids()) + 1]] == list(task_ids())


def test_render_a_battle(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    # The enemies are out of sight and hold, and the time limit is two steps.
    Path("quiet.toml").write_text(
        'description = "quiet"\nepisode_limit = 2\nenemy_order = { kind = "hold" }\n'
        'allies = [{ unit = "Marine", count = 1, at = [4.0, 16.0] }]\n'
        'enemies = [{ unit = "Marine", count = 1, at = [28.0, 16.0] }]\n'
    )
    race("render micro/quiet.toml --policy random")
    line = capsys.readouterr().out
    match = re.fullmatch(
        r"battle\.gif: (\d+) frames, 2 steps of the random policy, return 0, time\n", line
    )
    assert match is not None, line
    assert int(match[1]) > 17
    race("render micro/quiet.toml --seconds 0.3 --out first.mp4")
    line = capsys.readouterr().out
    assert line == "first.mp4: 9 frames, 1 steps of the scripted policy, return 0, not finished\n"
    assert {path.name for path in tmp_path.iterdir()} == {"quiet.toml", "battle.gif", "first.mp4"}
    with Image.open("battle.gif") as picture:
        assert picture.size == (960, 540)
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", "first.mp4"]
    about = subprocess.run(command, capture_output=True, text=True, check=False).stderr
    assert re.search(r"h264.* yuv420p.* 1920x1080.* 16 fps", about), about


@pytest.mark.parametrize(
    ("command", "hint"),
    [
        ("train mamujoco/HalfCheetah-2x4", "HalfCheetah-2x3"),
        ("train mamujoco/HalfCheeta-2x3", "HalfCheetah-2x3"),
        ("train HalfCheetah", "mamujoco/HalfCheetah"),
        ("train no_such_module:make", "no_such_module"),
        ("train probe/chain --race.population-size 4", "at least 5"),
        ("train probe/chain --race.population-size 3 --race.no-elite-copy", "at least 4"),
        ("train probe/chain --learner.batch-size 64 --learner.replay-capacity 32", "no larger"),
        ("train probe/chain --env-steps -5", "from 1"),
        ("train probe/chain --env-steps 10000", "more than the random steps"),
        ("train probe/chain --learner.discount 1.5", "[0, 1)"),
        ("train probe/chain --learner.gradient-clip nan", "finite"),
        ("train probe/chain --race.vmm-weight nan", "finite"),
        ("train probe/chain --checkpoint.minutes nan", "finite"),
        ("train probe/chain --learner.actor-learning-rate inf", "finite"),
        ("train probe/chain --seed -1", "from 0"),
        ("train probe/chain --race.mine-size 100000000000", "at most"),
        ("train probe/chain --learner.replay-capacity 100000000000", "at most"),
        ("train probe/chain --algo sarsa", "sarsa"),
        ("train probe/chain --learner.batch-size many", "many"),
        ("train", "required"),
        ("train probe/chain --no-such-flag 3", "no-such-flag"),
        ("evaluate nowhere", "not the directory of a run"),
        ("resume nowhere", "not the directory of a run"),
        ("render nowhere", "not the directory of a run"),
        ("render nowhere --out team.avi", ".mp4 or .gif"),
        ("render nowhere --policy random", "--team"),
        ("render micro/2s3y", "2s3z"),
        ("render micro/nowhere.toml", "cannot be read"),
        ("render micro/2s3z --out battle.avi", ".mp4 or .gif"),
        ("render micro/2s3z --team marl", "--policy"),
        ("render micro/2s3z --policy best", "scripted"),
        ("render micro/2s3z --seconds nan", "0 or more"),
        ("render micro/2s3z --seed 4294967296", "below"),
        ("train micro/2s3z --algo matd3", "--algo facmac"),
        ("train micro/2s3z --base maddpg", "--base facmac"),
        ("train micro/2s3z --facmac.batch-size 64 --facmac.replay-capacity 32", "minibatch"),
        ("train micro/2s3z --facmac.actor-learning-rate inf", "finite"),
        ("train micro/2s3z --facmac.epsilon-start 1.5", "[0, 1]"),
        ("train micro/2s3z --facmac.td-lambda nan", "td-lambda"),
        ("train probe/chain --base facmac --facmac.mixer-size 0", "at least 1"),
        ("train micro/2s3y", "2s3z"),
        ("plot", "which runs"),
        ("plot nowhere", "not a directory"),
    ],
)
def test_bad_input_gets_a_message_and_leaves_nothing(
    command: str,
    hint: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert hint in fails(command, capsys)
    assert list(tmp_path.iterdir()) == []


def test_bad_input_to_a_run(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    message = fails(f"train probe/chain --run-dir {run} {SMALL}", capsys)
    assert f"race resume {run}" in message
    assert "at least 1" in fails(f"evaluate {run} --episodes 0", capsys)
    assert "rgb_array" in fails(f"render {run} --out {run / 'team.mp4'}", capsys)
    assert "Nearest" in fails(f"plot {run} --metric retrun --out {run / 'a.png'}", capsys)


def test_a_champion_needs_a_population(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    race(f"train probe/terminates --algo matd3 --run-dir {tmp_path / 'run'} {alone(SMALL)}")
    capsys.readouterr()
    assert "no population" in fails(f"evaluate {tmp_path / 'run'} --team champion", capsys)


def damage(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(bytes(content))


def truncate(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


@pytest.mark.parametrize("how", [damage, truncate, Path.unlink])
@pytest.mark.parametrize("file", ["arrays.safetensors", "manifest.json"])
def test_a_damaged_checkpoint_is_refused(
    run: Path, capsys: pytest.CaptureFixture[str], how: Any, file: str
) -> None:
    newest = checkpoints.newest(run / "checkpoints")
    assert newest is not None
    how(newest / file)
    rows = (run / "metrics.jsonl").read_bytes()
    for command in (f"resume {run} --env-steps 500", f"evaluate {run}", f"render {run}"):
        assert newest.name in fails(command, capsys)
    assert (run / "metrics.jsonl").read_bytes() == rows


def test_a_checkpoint_of_another_run_is_refused(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    race(f"train probe/chain --run-dir {tmp_path / 'other'} {SMALL}")
    shutil.rmtree(run / "checkpoints")
    shutil.copytree(tmp_path / "other" / "checkpoints", run / "checkpoints")
    capsys.readouterr()
    assert "checkpoint" in fails(f"resume {run} --env-steps 500", capsys)
    assert "checkpoint" in fails(f"evaluate {run}", capsys)


def test_a_run_of_another_seed_is_another_run(
    trained: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    race(f"train probe/terminates --seed 2 --run-dir {tmp_path / 'other'} {SMALL}")
    capsys.readouterr()
    for part in ("checkpoints", "config.json", "metrics.jsonl"):
        mixed = Path(shutil.copytree(trained, tmp_path / f"mixed-{part}"))
        other = tmp_path / "other" / part
        if other.is_dir():
            shutil.rmtree(mixed / part)
            shutil.copytree(other, mixed / part)
        else:
            shutil.copy(other, mixed / part)
        commands = {"resume --env-steps 500": "another run"}
        if part != "metrics.jsonl":
            commands |= {"evaluate": "belongs to another run", "render": "another run"}
        if part != "checkpoints":
            commands |= {"plot": "another run"}
        for command, told in commands.items():
            name, *options = command.split()
            message = fails(" ".join([name, str(mixed), *options]), capsys)
            assert told in message, (part, command, message)


def test_lost_metrics_are_no_end(
    trained: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "has no effect" in fails(f"resume {run} --env-steps 500 --without-metrics", capsys)
    text = (run / "metrics.jsonl").read_text()
    (run / "metrics.jsonl").write_text(text.replace('"generation": 1', '"generation": 7', 1))
    for command in (f"resume {run} --env-steps 150", f"plot {run} --out {tmp_path / 'a.png'}"):
        message = fails(command, capsys)
        assert "are not those that were there" in message
        assert f"race resume {run} --without-metrics" in message
    race(f"resume {run} --env-steps 150 --without-metrics")
    whole = Path(shutil.copytree(trained, tmp_path / "whole"))
    race(f"resume {whole} --env-steps 150")
    old = [json.loads(line) for line in text.splitlines()]
    first, *rows = metrics.read(run / "metrics.jsonl")
    assert (first["kind"], first["run"]) == ("note", old[0]["run"])
    assert "were lost" in first["note"]
    assert first["env_steps"] == old[-1]["env_steps"]
    timeless = re.compile("wall_seconds|time/.*")
    expected = metrics.read(whole / "metrics.jsonl")[len(old) :]
    for row, other in zip(rows, expected, strict=True):
        assert all(row[k] == other[k] for k in other if not timeless.match(k))
    assert (run / "metrics-lost-1.jsonl").read_text() != text
    race(f"plot {run} --out {tmp_path / 'a.png'}")
    (run / "metrics.jsonl").unlink()
    race(f"resume {run} --env-steps 180 --without-metrics")
    assert metrics.read(run / "metrics.jsonl")[0]["kind"] == "note"


def test_a_config_of_another_program_is_refused(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (run / "config.json").write_text('{"some": "thing"}')
    for command in ("resume", "evaluate", "render", "plot"):
        assert "config" in fails(f"{command} {run}", capsys)


def test_ablations_are_named_recorded_and_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    made: list[Config] = []
    monkeypatch.setattr("race.cli.training.run", lambda path, config: made.append(config))
    race(f"train probe/target --ablation vmm-only no-injection {SMALL}")
    (path,) = (tmp_path / "runs").iterdir()
    assert path.name == "probe-target-race-matd3-vmm-only-no-injection-seed1"
    assert run_directory.open_run(path) == made[0]
    assert made[0].ablation == ("vmm-only", "no-injection")
    error = fails("train probe/target --ablation vmm-only vfm-only", capsys)
    assert "the encoders would learn from nothing" in error
    error = fails("train probe/target --algo matd3 --ablation vmm-only", capsys)
    assert "another method" in error
    assert "--ablation" in fails("train probe/target --ablation vmm", capsys)


def test_describe(capsys: pytest.CaptureFixture[str]) -> None:
    race("describe mamujoco/Humanoid-9x8")
    text = capsys.readouterr().out
    assert "2 agents with continuous actions" in text
    assert "ends after 1,000 steps" in text
    assert re.search(r" 3  right_shoulder1 +-0.4 to 0.4, entry 11 of the joint action\n", text)
    assert re.search(r"\n +0  abdomen_x position +entry 7 of the state\n", text)
    race("describe probe/matching")
    text = capsys.readouterr().out
    assert "every agent (agent 0, agent 1) observes 4 entries, which have no names" in text
    race("describe pettingzoo:mpe2.simple_tag_v3 --env.agents adversary_* --json")
    told = json.loads(capsys.readouterr().out)
    assert (told["n_agents"], told["other_agents"]) == (3, ["agent_0"])
    assert len(told["names"]["state"]) == told["state_size"] == 62
    assert "no task 'mamujoco/Hoper-3x1'" in fails("describe mamujoco/Hoper-3x1", capsys)


def test_a_real_cluster_goes_on_with_a_run(run: Path) -> None:
    """The smallest that a real Ray is asked to do; `test_cluster` says more, slowly."""
    (run / "DONE").unlink()
    before = rows(run)
    words = [sys.executable, "-m", "race", "resume", str(run.parent), "--on", "ray"]
    # A process of its own: Ray leaves threads and handlers of signals behind.
    done = subprocess.run(words, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr + done.stdout
    assert "All 1 runs have finished" in done.stdout
    assert (run / "DONE").exists()
    assert "Finished after" in (run / "log.txt").read_text()  # said by the process that was sent
    assert rows(run) == before
    assert not list(run.parent.glob(".cluster-*"))


def test_lost_metrics_are_not_taken_for_a_young_run(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (run / "metrics.jsonl").unlink()
    for command in ("compare", "plot"):
        assert "rows are missing" in fails(f"{command} {run}", capsys)
