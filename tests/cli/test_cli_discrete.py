"""The commands on tasks with discrete actions."""

import functools
import json
import re
from pathlib import Path
from typing import Any, ClassVar

import imageio.v3 as imageio
import numpy as np
import pytest
from commands import alone, fails, race
from PIL import Image, ImageSequence

from race.envs import micro
from race.envs.discrete_probe.host import ProbeHost
from race.envs.pymarl import pymarl_task
from race.errors import ConfigError, TaskError
from race.rollouts.base import Trial
from race.rollouts.discrete import EpisodeRollouts
from race.runs import metrics
from race.teams.trained import load_trained
from race.types import DiscreteTask

MIXER = "--facmac.mixer-size 3 --facmac.hypernet-size 4"
RACE = (
    "--race.policy-embedding-size 4 --race.mine-size 5 --race.population-size 4 "
    "--race.no-elite-copy "
    "--evaluation.every 40 --evaluation.episodes 2"
)
SMALL = (
    f"{MIXER} {RACE} --facmac.hidden-size 6 --facmac.utility-sizes 5 4 --facmac.value-size 4 "
    "--facmac.batch-size 4"
)
DRAWN = "test_cli_discrete:drawn"


class Drawn:
    """``probe/lives`` with PyMARL's interface and a picture: as grey as steps were made."""

    made: ClassVar[list["Drawn"]] = []

    def __init__(self) -> None:
        self.env, self.steps, self.closed = ProbeHost("probe/lives"), 0, False
        self.made.append(self)

    def reset(self) -> None:
        self.env.reset()
        self.steps = 0

    def step(self, actions: Any) -> Any:
        self.steps += 1
        return self.env.step(actions)

    def render(self, mode: str) -> Any:
        return np.full((32, 48, 3), 40 * self.steps, np.uint8)

    def close(self) -> None:
        self.closed = True

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)


def drawn() -> DiscreteTask:
    return pymarl_task(Drawn, DRAWN)


def without_a_game() -> DiscreteTask:
    return pymarl_task(functools.partial(open, "no game here"), "absent")


@pytest.fixture(scope="module")
def run_of(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """(algorithm, task, environment steps) -> the directory of a finished run."""

    @functools.cache
    def make(algo: str, task: str, env_steps: int = 40) -> Path:
        path = tmp_path_factory.mktemp("runs") / "run"
        options = SMALL if algo == "race" else alone(SMALL)
        race(f"train {task} --algo {algo} --run-dir {path} --env-steps {env_steps} {options}")
        return path

    return make


@pytest.fixture
def memory(run_of: Any) -> Path:
    return Path(run_of("race", "probe/memory"))


@pytest.fixture(scope="module")
def short_map(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``micro/3s_vs_3z`` with the enemies nearer and an end after eight steps."""
    text = (Path(micro.__file__).parent / "maps" / "3s_vs_3z.toml").read_text("utf-8")
    assert text.count("episode_limit = 150") == text.count("[23.0, 16.0]") == 1
    path = tmp_path_factory.mktemp("maps") / "short.toml"
    text = text.replace("episode_limit = 150", "episode_limit = 8")
    path.write_text(text.replace("[23.0, 16.0]", "[14.0, 16.0]"))
    return path


@pytest.fixture
def battle(run_of: Any, short_map: Path) -> Path:
    return Path(run_of("race", f"micro/{short_map}"))


@pytest.fixture(autouse=True)
def away(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_training_tells_returns_and_wins(capsys: pytest.CaptureFixture[str]) -> None:
    race(f"train probe/memory --env-steps 40 {SMALL}")
    out = capsys.readouterr().out
    assert "RACE(FACMAC) on probe/memory, seed 1, in runs/probe-memory-race-facmac-seed1" in out
    number = r"-?[\d.]+"
    team = rf"{number} ± {number} \(\d+% won\)"
    line = rf" +45 steps, generation +3, +\d+m\d\ds: test return MARL team {team}, champion {team}"
    assert re.search(line, out), out
    assert "Finished after 45 environment steps. Next: race evaluate" in out
    assert "race render" not in out  # a probe has no picture
    saved = json.loads(Path("runs/probe-memory-race-facmac-seed1/config.json").read_text())
    assert (saved["discrete"], saved["base"]) == (True, "facmac")
    described = Path("runs/probe-memory-race-facmac-seed1/metadata.json").read_text()
    assert '"n_actions": 2' in described


def test_evaluation_tells_wins(memory: Path, capsys: pytest.CaptureFixture[str]) -> None:
    results = {}
    for team in ("marl", "champion", "selected"):
        race(f"evaluate {memory} --team {team} --episodes 23 --seed 5 --json")
        results[team] = json.loads(capsys.readouterr().out)
        returns = results[team]["returns"]
        assert len(returns) == 23
        assert set(returns) <= {0.0, 0.5, 1.0}
        assert results[team]["win_rate"] == pytest.approx(np.mean([r == 1 for r in returns]))
        assert results[team]["length_mean"] == 3
    played = results["selected"]["played"]
    assert results["selected"]["returns"] == results[played]["returns"]
    race(f"evaluate {memory} --team {played} --episodes 23 --seed 5")
    text = capsys.readouterr().out
    assert text.endswith(f"episode length 3, won {results[played]['win_rate']:.1%}\n")
    assert "RACE(FACMAC) on probe/memory, 45 environment steps" in text


def test_what_cannot_be_won_has_no_win_rate(
    run_of: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    path = run_of("facmac", "probe/matching", 10)
    capsys.readouterr()
    race(f"evaluate {path} --json")
    assert "win_rate" not in json.loads(capsys.readouterr().out)
    race(f"evaluate {path}")
    assert "won" not in capsys.readouterr().out
    message = fails(f"plot {path} --metric win_rate", capsys)
    assert "no values of 'win_rate'" in message
    assert "no population" in fails(f"evaluate {path} --team champion", capsys)
    assert not Path("curves.png").exists()


def test_plot_win_rates(memory: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    race(f"plot {memory} --metric win_rate --team all --out wins.png")
    out = capsys.readouterr().out
    last = metrics.read(memory / "metrics.jsonl")[-1]
    for label, team in (("MARL team", "marl"), ("champion", "champion")):
        value = f"{last[f'eval/{team}/win_rate']:.3g}"
        line = f"probe/memory, RACE(FACMAC), {label}: win_rate {value} at 45 environment steps"
        assert line in out
    assert imageio.imread("wins.png").std() > 0


@pytest.mark.slow
def test_a_finished_run_is_extended(run_of: Any, capsys: pytest.CaptureFixture[str]) -> None:
    path = run_of("facmac", "probe/lives", 20)
    capsys.readouterr()
    assert "has finished" in fails(f"resume {path}", capsys)
    assert "would not extend" in fails(f"resume {path} --env-steps 15", capsys)
    before = metrics.read(path / "metrics.jsonl")
    race(f"resume {path} --env-steps 40")
    after = metrics.read(path / "metrics.jsonl")
    assert after[: len(before)] == before
    assert after[-1]["env_steps"] >= 40


def test_fewer_steps_than_were_made_are_refused(
    run_of: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    path = run_of("facmac", DRAWN, 10)
    capsys.readouterr()
    # The buffer of a run of so few steps would be too small for what the run holds.
    assert "--env-steps 1 would not extend it" in fails(f"resume {path} --env-steps 1", capsys)


# Pictures.


def shown_for(path: str) -> float:
    """Seconds of an animation."""
    with Image.open(path) as pictures:
        return sum(frame.info["duration"] for frame in ImageSequence.Iterator(pictures)) / 1000


@pytest.mark.slow
def test_a_battle_of_a_run_is_drawn(battle: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trained = load_trained(battle)
    with EpisodeRollouts(trained.config, trained.task) as rollouts:
        heads = {"champion": trained.heads["champion"]}
        score = rollouts.test([Trial(trained.encoders["champion"], heads, np.array([7]))])[0][
            "champion"
        ]
    steps, worth = int(score.lengths[0]), float(score.returns[0])
    capsys.readouterr()
    race(f"render {battle} --team champion --seed 7 --seconds 0 --out whole.gif")
    line = capsys.readouterr().out
    match = re.fullmatch(
        r"whole\.gif: (\d+) frames, (\d+) steps of the champion, return ([\d.]+), (\w+)\n", line
    )
    assert match is not None, line
    # The battle that is drawn is the one that was played.
    assert int(match[2]) == steps
    assert float(match[3]) == pytest.approx(worth, rel=0.01)
    assert match[4] == "won" if score.won[0] else match[4] in ("lost", "draw", "time")
    assert int(match[1]) > 8 * steps
    # Equal frames in a row become one that is shown longer; a .gif counts hundredths of seconds.
    assert shown_for("whole.gif") == pytest.approx(int(match[1]) / 16, rel=0.05)
    first, later = (imageio.imread("whole.gif", index=place) for place in (5, 40))
    assert first.shape == later.shape == (*first.shape[:2], 3)
    assert (first != later).any()

    race(f"render {battle} --team champion --seed 7 --seconds 1.2 --out begin.gif")
    line = capsys.readouterr().out
    assert re.search(r"frames, 3 steps of the champion, return [\d.]+, not finished", line), line
    assert shown_for("begin.gif") < shown_for("whole.gif")


@pytest.mark.slow
def test_a_battle_is_evaluated(battle: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    race(f"evaluate {battle} --team marl --episodes 4 --json")
    result = json.loads(capsys.readouterr().out)
    assert 0 <= result["win_rate"] <= 1
    assert 1 <= result["length_mean"] <= 8
    assert len(result["returns"]) == 4


@pytest.mark.slow
def test_an_environment_of_one_s_own_is_drawn_by_itself(
    run_of: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    path = run_of("race", DRAWN)
    capsys.readouterr()
    Drawn.made.clear()
    race(f"render {path} --out own.gif")
    line = capsys.readouterr().out
    match = re.fullmatch(
        r"own\.gif: (\d) frames, (\d) steps of the (MARL team|champion), return [\d.]+\n", line
    )
    assert match is not None, line
    frames = imageio.imread("own.gif", index=None)
    assert len(frames) == int(match[1]) == int(match[2]) + 1
    assert [int(frame[0, 0, 0]) for frame in frames] == [40 * step for step in range(len(frames))]
    assert all(env.closed for env in Drawn.made)
    race(f"render {path} --seconds 0.6 --out own.gif")
    assert ": 3 frames, 2 steps" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "hint"),
    [
        ("", "probe/memory has no picture"),
        ("--policy random", "--team"),
        ("--seed 2147483648", "below 2147483648"),
        ("--seed -1", "0 or more"),
        ("--out team.avi", ".mp4 or .gif"),
    ],
)
def test_what_cannot_be_drawn(
    memory: Path, tmp_path: Path, options: str, hint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert hint in fails(f"render {memory} {options}", capsys)
    assert list(tmp_path.iterdir()) == []


def test_a_champion_cannot_be_drawn_without_a_population(
    run_of: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = run_of("facmac", DRAWN, 10)
    capsys.readouterr()
    assert "no population" in fails(f"render {path} --team champion", capsys)
    assert list(tmp_path.iterdir()) == []


def test_an_environment_that_fails_while_it_is_drawn(
    run_of: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = run_of("facmac", DRAWN, 10)

    def render(self: Drawn, mode: str) -> Any:
        raise OSError("the display is gone")

    monkeypatch.setattr(Drawn, "render", render)
    capsys.readouterr()
    message = fails(f"render {path} --out own.gif", capsys)
    assert "failed while it was drawn, in the reset of the episode of seed 0" in message


def test_a_trained_team_plays_in_python(run_of: Any) -> None:
    path = run_of("facmac", DRAWN, 10)
    trained = load_trained(path)
    with EpisodeRollouts(trained.config, trained.task) as rollouts:
        team = trained.acting("marl")
        expected = [rollouts.episode(team, seed) for seed in (3, 4, 5)]
    policy = trained.recurrent_policy("selected")
    env = trained.task.make(None)
    for seed, actions in zip((3, 4, 5), expected, strict=True):
        policy.reset()
        seen, _ = env.reset(seed=seed)
        for step, joint in enumerate(actions):
            chosen = policy(seen["obs"], seen["avail_actions"])
            np.testing.assert_array_equal(chosen, joint)
            seen, _, terminated, truncated, _ = env.step(chosen)
            assert (terminated or truncated) == (step == len(actions) - 1)
    for obs, avail, told in (
        (seen["obs"][:1], seen["avail_actions"], r"of .*drawn may show: obs has shape \(1, 4\)"),
        (seen["obs"] + np.nan, seen["avail_actions"], "obs is nan"),
        (seen["obs"], seen["avail_actions"] - 0.5, "must say 1 or 0"),
    ):
        with pytest.raises(TaskError, match=told):
            policy(obs, avail)
    with pytest.raises(ConfigError, match="recurrent_policy"):
        trained.policy("marl")


# Settings.

OUT_OF_RANGE = {
    "mixer-size": ("0", "16385"),
    "hypernet-size": ("0", "16385"),
    "hidden-size": ("0", "16385"),
    "utility-sizes": ("0 4", "4 0", "4 16385"),
    "value-size": ("0", "16385"),
    "batch-size": ("1", "16385"),
    "actor-learning-rate": ("0", "-1", "nan", "inf"),
    "critic-learning-rate": ("0", "-1", "nan", "inf"),
    "encoder-learning-rate": ("0", "-1", "nan", "inf"),
    "last-layer-scale": ("0", "-1", "nan", "inf"),
    "gradient-clip": ("0", "nan", "inf"),
    "discount": ("1", "-0.1", "nan"),
    "td-lambda": ("-0.1", "1.1", "nan"),
    "target-update-every": ("0",),
    "epsilon-start": ("-0.1", "1.1", "nan"),
    "epsilon-finish": ("-0.1", "1.1", "nan"),
    "epsilon-steps": ("0",),
    "replay-capacity": ("31", "1073741825"),
    "replay-precision": ("float64",),
    "gradient-steps-per-episode": ("0", "101", "nan", "inf"),
}


@pytest.mark.parametrize("setting", OUT_OF_RANGE)
def test_settings_out_of_range_name_themselves(
    setting: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for value in OUT_OF_RANGE[setting]:
        message = fails(f"train probe/matching --facmac.{setting} {value}", capsys)
        assert f"--facmac.{setting}" in message
    assert list(tmp_path.iterdir()) == []


def test_every_setting_of_facmac_is_tried() -> None:
    from dataclasses import fields

    from race.config.settings import FacmacConfig

    ranged = [f.name for f in fields(FacmacConfig) if f.type is not bool]
    assert set(OUT_OF_RANGE) == {name.replace("_", "-") for name in ranged}


@pytest.mark.parametrize(
    ("command", "hint"),
    [
        ("train micro/2s3z --algo matd3", "Use --algo facmac, or --algo race with --base facmac"),
        ("train micro/2s3z --algo maddpg", "Use --algo facmac"),
        ("train probe/matching --base matd3", "RACE(MATD3) does not work on probe/matching"),
        ("train probe/matchin", "probe/matching"),
        ("train micro/3s_vs_9z", "nearest names are 3s_vs_"),
        (
            "train test_cli_discrete:without_a_game",
            "without_a_game failed: FileNotFoundError: [Errno 2] No such file or directory: "
            "'no game here'",
        ),
        ("train probe/matching --race.population-size 3", "for no population use --algo facmac"),
        ("train probe/matching --env.agent-obsk 1", "--env.agent-obsk would have no effect"),
        ("train probe/matching --preset td3", "--preset td3 has no effect on probe/matching"),
        (
            "train probe/matching --learner.batch-size 8 --learner.discount 0.9",
            "--learner.batch-size and --learner.discount would have no effect",
        ),
        ("train probe/chain --facmac.mixer-size 8", "--facmac.mixer-size would have no effect"),
        (
            "train probe/chain --algo facmac --facmac.mixer-size 8 --facmac.td-lambda 0.5",
            "--facmac.td-lambda would have no effect",
        ),
    ],
)
def test_what_cannot_be_trained(
    command: str, hint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert hint in fails(command, capsys)
    assert list(tmp_path.iterdir()) == []


def test_facmac_on_continuous_actions(capsys: pytest.CaptureFixture[str]) -> None:
    continuous = (
        "--learner.random-steps 30 --learner.batch-size 8 --learner.hidden-sizes 12 8 "
        "--env-steps 60 --learner.gradient-steps-per-env-step 0.1"
    )
    race(f"train mamujoco/Hopper-3x1 --base facmac --run-dir run {continuous} {MIXER} {RACE}")
    assert "RACE(FACMAC) on mamujoco/Hopper-3x1" in capsys.readouterr().out
    race("evaluate run --episodes 2 --json")
    result = json.loads(capsys.readouterr().out)
    assert result["method"] == "RACE(FACMAC)"
    assert "win_rate" not in result
    assert json.loads(Path("run/config.json").read_text())["discrete"] is False
