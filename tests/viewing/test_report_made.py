"""What a page shows beside rows: distances between teams, battles to step through, videos."""

import base64
import gzip
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from test_report import generations
from written_runs import written_run

from race.envs.micro import make, state
from race.envs.micro.battle import LOOPS_PER_STEP
from race.envs.micro.recording import Recording
from race.envs.micro.state import Units
from race.errors import RaceError
from race.runs import archive, checkpoints
from race.runs.recorded import Recorded
from race.runs.results import load
from race.viewing.rendering import write_video
from race.viewing.report import playing
from race.viewing.report.battles import as_numbers, packed
from race.viewing.report.content import content_of
from race.viewing.report.distances import distances_of, relative, weights_of
from race.viewing.report.made import Maker
from race.viewing.report.playing import Player

TEAMS = "['algorithm'].population.teams."
HEADS = np.arange(12, dtype=np.float32).reshape(3, 2, 2, 1)  # [P, N, H1, A]
SHARED = np.array([[[1.0], [2.0]]], np.float32)  # one head for both agents


def arrays(**more: Any) -> dict[str, Any]:
    return {
        f"{TEAMS}heads": HEADS,
        "['algorithm'].population.record.now.id": np.array([4, 9, 7], np.int32),
        "['algorithm'].population.elite": np.array(1, np.int32),
        **more,
    }


def save(run: Path, steps: int, held: dict[str, Any]) -> None:
    info = {"progress": {"env_steps": steps}}
    checkpoints.save(run / "checkpoints", f"step-{steps:012d}", held, info, {}, keep=5)


def test_distances_are_relative_to_the_lengths_of_both() -> None:
    found = relative(np.array([[3.0, 4.0], [3.0, 4.0], [-3.0, -4.0], [-4.0, 3.0], [0.0, 0.0]]))
    assert found[0] == pytest.approx([0.0, 0.0, 2.0, 2**0.5, 2**0.5])
    assert found[4, 4] == 0.0  # two of nothing are equal
    assert (found == found.T).all()


def test_weights_are_heads_or_whatever_evolves() -> None:
    marl = {"['algorithm'].policies.head.params": SHARED}
    found = weights_of(arrays(**marl))
    assert found is not None
    assert found.tolist() == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 10, 11], [1, 2, 1, 2]]
    encoder = {f"{TEAMS}encoder.weight": np.full((3, 2, 5), 2.0, np.float32)}
    whole = weights_of(arrays(**encoder, **marl))
    assert whole is not None
    assert whole.shape == (3, 10 + 4)  # a MARL team of other networks is not compared
    assert weights_of(marl) is None


def test_distances_in_the_checkpoints_of_a_run(tmp_path: Path) -> None:
    assert distances_of(tmp_path) is None
    save(tmp_path, 100, arrays(**{f"{TEAMS}heads": np.zeros_like(HEADS)}))
    head = {"['algorithm'].policies.head.params": HEADS[1]}  # the elite's
    save(tmp_path, 200, arrays(**head))
    found = distances_of(tmp_path)
    assert found is not None
    assert found["steps"] == [100, 200]
    assert found["teams"] == ["team 4", "team 9 (elite)", "team 7", "MARL team"]
    assert found["to_marl"] == [None, 0.0]
    first, second, third = (HEADS[k].ravel().astype(float) for k in range(3))

    def apart(a: Any, b: Any) -> float:
        return float(np.linalg.norm(a - b) / np.sqrt((a @ a + b @ b) / 2))

    pairs = [apart(first, second), apart(first, third), apart(second, third)]
    assert found["mean"] == [0.0, pytest.approx(np.mean(pairs), rel=1e-3)]
    assert found["matrix"][0][1:3] == pytest.approx(pairs[:2], rel=1e-3)
    (tmp_path / "checkpoints/step-000000000200/arrays.safetensors").write_bytes(b"torn")
    with pytest.raises(RaceError, match="cannot be used"):
        distances_of(tmp_path)


@pytest.fixture(scope="module")
def fought() -> tuple[Any, Recording]:
    """Two steps of 3m: agent 0 shoots at enemy 4 in the first, and then enemy 4 is dead."""
    played = make("3m")
    units = state.start(played.scenario).units
    moments = [jax.tree.map(lambda leaf: np.array(leaf), units) for _ in range(1 + 16)]
    for loop in range(3, 17):
        now = moments[loop]
        now.x[0] += 0.25 * loop
        now.cooldown[0], now.struck[0] = 19.0 - loop, 4
        now.health[4] = 45.0 / 2 if loop <= LOOPS_PER_STEP else 0.0
    stacked = Units(*(np.stack(leaves) for leaves in zip(*moments, strict=True)))
    return played, Recording(stacked, np.array([0.5, 1.25]), "won")


def test_a_battle_as_numbers(fought: tuple[Any, Recording]) -> None:
    played, recording = fought
    told = as_numbers(played, recording)
    assert (told["map"], told["limit"], told["agents"], told["verdict"]) == ("3m", 60, 3, "won")
    assert told["returns"] == [0.0, 0.5, 1.25]
    x = recording.units.x
    assert [row[0] for row in told["x"]] == [round(100 * float(x[k, 0])) for k in (0, 8, 16)]
    assert [row[4] for row in told["health"]] == [100, 50, 0]
    assert told["shield"] is None
    assert told["targets"] == [[-1] * 6, [4, *[-1] * 5], [-1] * 6]
    assert told["labels"] == ["M0", "M1", "M2", "M", "M", "M"]
    left, bottom, right, top = told["window"]
    assert left <= float(x.min()) <= float(x.max()) <= right
    assert (right - left) / (top - bottom) <= 2.01  # no narrow strip
    rows = told["ground"]
    assert len(rows) == np.ceil(top) - int(bottom)
    assert {len(row) for row in rows} == {int(np.ceil(right)) - int(left)}
    assert {*"".join(rows)} <= {*".^#"}
    again = json.loads(gzip.decompress(base64.b64decode(packed(told))))
    assert again == told
    assert len(packed(told)) < 2000


def test_only_nobody_alive_has_no_health(fought: tuple[Any, Recording]) -> None:
    played, recording = fought
    health = np.full_like(recording.units.health, 0.001)
    told = as_numbers(played, recording._replace(units=recording.units._replace(health=health)))
    assert {value for row in told["health"] for value in row} == {1}


class Played:
    """Stands for teams that play."""

    asked: list[str]

    def __init__(self, run: Recorded, tell: Any) -> None:
        self._run = run

    def battle(self) -> dict[str, Any]:
        Played.asked.append(f"battle {self._run.config.seed}")
        return {"who": "champion", "seed": 0, "packed": ""}

    def video(self) -> dict[str, Any]:
        Played.asked.append(f"video {self._run.config.seed}")
        if self._run.config.seed == 2:
            raise RaceError("it has no pictures")
        return {"told": "team.mp4", "data": ""}


@pytest.fixture
def battles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Three seeds on a battle; the first has no checkpoint yet."""
    monkeypatch.setattr(playing, "Player", Played)
    Played.asked = []
    for seed in (1, 2, 3):
        rows = generations() if seed == 3 else None
        run = written_run(
            *(tmp_path / str(seed), [(100, 1.0)], None, "return_mean", rows),
            task="micro/3m",
            seed=seed,
        )
        if seed > 1:
            save(run, 100, arrays())
    return tmp_path


def test_the_first_seed_that_can_fights_and_nothing_is_made_twice(battles: Path) -> None:
    maker, runs = Maker("first"), load([battles])
    made = maker.made_of(runs)
    assert Played.asked == ["battle 2"]
    assert {name: sorted(kinds) for name, kinds in made.of_runs.items()} == {
        str(battles / "2"): ["battle", "distances"],
        str(battles / "3"): ["distances"],
    }
    assert maker.made_of(runs) == made
    assert Played.asked == ["battle 2"]
    save(battles / "2", 300, arrays())  # what follows a new checkpoint is new
    maker.made_of(runs)
    assert Played.asked == ["battle 2", "battle 2"]
    shown = content_of(runs, "auto", "selected", None, made)
    assert [sorted({"battle", "distances", "video"} & {*run}) for run in shown["runs"]] == [
        [],
        ["battle", "distances"],
        ["distances"],
    ]


def test_what_cannot_be_made_is_told_and_the_rest_is_there(battles: Path) -> None:
    archive.write(battles / "old.jsonl.gz", load([battles / "1"]))
    runs = load([battles / "1", battles / "2", battles / "3"])
    kept = load([battles / "old.jsonl.gz"])
    told: list[tuple[str, int, int]] = []
    made = Maker("all", videos=True, tell=lambda *what: told.append(what)).made_of([*runs, *kept])
    assert Played.asked == [f"{kind} {seed}" for seed in (1, 2, 3) for kind in ("battle", "video")]
    assert made.remarks == [
        f"{battles / '2'}: no video. it has no pictures",
        "1 of 4 runs come from archives, which keep no teams to show.",
    ]
    assert [done for _, done, total in told if total == 3] == [0, 1, 2]
    assert Maker().made_of([*runs, *kept]).of_runs.keys() == {str(battles / s) for s in "23"}


def test_a_video_that_is_there_is_taken(tmp_path: Path) -> None:
    run = written_run(tmp_path / "run", [(100, 1.0)])
    (run / "short.mp4").write_bytes(b"a film")
    (recorded,) = load([run])
    made = Player(recorded, lambda *what: None).video()
    assert made == {"told": "short.mp4", "data": base64.b64encode(b"a film").decode()}
    (run / "short.mp4").write_bytes(bytes(playing.MOST_BYTES + 1))
    with pytest.raises(RaceError, match="no checkpoint yet"):  # and so none can be made
        Player(recorded, lambda *what: None).video()


def test_videos_become_as_large_as_they_may(tmp_path: Path) -> None:
    """Noise, which nothing makes smaller but less sharpness."""
    noise = np.random.default_rng(0).integers(0, 256, (45, 120, 160, 3), dtype=np.uint8)
    write_video(iter(noise), tmp_path / "free.mp4", 15.0)
    write_video(iter(noise), tmp_path / "small.mp4", 15.0, 8 * 100_000 / 4)
    assert (tmp_path / "free.mp4").stat().st_size > 200_000
    assert (tmp_path / "small.mp4").stat().st_size < 100_000
