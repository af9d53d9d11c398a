"""Loggers get every row once, and none can stop a run."""

import json
import sqlite3
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest

from race.config import saved as configs
from race.config.presets import resolve
from race.config.settings import Config
from race.errors import ConfigError
from race.runs.loggers import sending
from race.runs.loggers.base import Logged, Point, point_of
from race.runs.loggers.sending import Loggers, choose, chosen, refuse_missing

CONFIG = resolve(Config("probe/target", seed=3))


class Fake:
    """A logger that remembers, and fails when told to."""

    opened: list["Fake"]
    failing = False

    def __init__(self, run: Logged) -> None:
        self.run, self.points, self.pictures = run, list[Point](), list[str]()
        self.closed: bool | None = None
        type(self).opened.append(self)

    def send(self, points: Sequence[Point]) -> None:
        if self.failing:
            raise ConnectionError("the server is away")
        self.points += points

    def picture(self, name: str, file: Path, env_steps: int) -> None:
        self.pictures.append(f"{name} at {env_steps}")

    def close(self, finished: bool) -> None:
        self.closed = finished


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> type[Fake]:
    kind = type("Kind", (Fake,), {"opened": []})
    monkeypatch.setattr(sending, "OPENERS", {"wandb": ("json", kind)})
    monkeypatch.setattr(sending, "SEND_EVERY", -1.0)
    return kind


def row_at(steps: int, kind: str = "generation") -> dict[str, Any]:
    return {
        **{"kind": kind, "generation": steps // 10, "env_steps": steps},
        **{"wall_seconds": steps / 100, "loss/critic": 1.0 / steps, "loss/mine": None},
        "teams": [{"id": 1}],
    }


class Writer:
    """Writes rows as a run does, and tells its loggers."""

    def __init__(self, path: Path) -> None:
        self.file, self.loggers = path / "metrics.jsonl", Loggers(path, CONFIG)

    def rows(self, *rows: dict[str, Any]) -> "Writer":
        for row in rows:
            with self.file.open("a") as file:
                file.write(json.dumps(row) + "\n")
            self.loggers.report(row)
        return self

    def keep(self, count: int) -> None:
        """As a run that goes on from a checkpoint drops the rows after it."""
        lines = self.file.read_text().splitlines(keepends=True)
        self.file.write_text("".join(lines[:count]))


def steps(fakes: list[Fake]) -> list[int]:
    return [point.env_steps for logger in fakes for point in logger.points]


def test_numbers_of_a_row() -> None:
    point = point_of(row_at(20) | {"done": True, "bad": float("nan"), "np": np.float32(0.5)})
    assert (point.env_steps, point.wall_seconds) == (20, 0.2)
    assert point.values == {
        "generation": 2.0, "wall_seconds": 0.2, "loss/critic": 0.05, "np": 0.5
    }  # fmt: skip


def test_every_row_comes_once_however_often_a_run_goes_on(tmp_path: Path, fake: type[Fake]) -> None:
    choose(tmp_path, ("wandb",))
    first = Writer(tmp_path).rows(row_at(10), row_at(20), row_at(20, "evaluation"), row_at(30))
    # Killed: nothing is closed. The checkpoint was at the first row; the others come again.
    del first
    again = Writer(tmp_path)
    again.keep(1)
    again.rows(row_at(20), row_at(20, "evaluation"), row_at(30), row_at(40))
    again.loggers.end(finished=False)
    assert steps(fake.opened) == [10, 20, 20, 30, 40]
    assert fake.opened[-1].closed is False
    # It goes on in the same logged run: what a logger keeps is there again.
    assert fake.opened[1].run.kept["mark"] == [40, 0]


def test_what_a_logger_missed_is_told_when_the_run_goes_on(
    tmp_path: Path, fake: type[Fake], capsys: pytest.CaptureFixture[str]
) -> None:
    choose(tmp_path, ("wandb",))
    writer = Writer(tmp_path).rows(row_at(10))
    fake.failing = True
    writer.rows(row_at(20), row_at(30), row_at(40))
    writer.loggers.end(finished=False)
    said = capsys.readouterr().err
    assert said.count("the logger wandb failed") == 1
    assert "the server is away" in said
    fake.failing = False
    Writer(tmp_path).rows(row_at(50)).loggers.end(finished=True, pictures={"curve": tmp_path})
    # The row at 20 was being sent when it failed: it may have come, so it is not sent again.
    assert steps(fake.opened) == [10, 30, 40, 50]
    assert fake.opened[-1].pictures == ["curve at 50"]
    assert fake.opened[-1].closed is True


def test_many_rows_are_sent_in_parts(tmp_path: Path, fake: type[Fake]) -> None:
    choose(tmp_path, ("wandb",))
    rows = [row_at(10 * k) for k in range(1, 2 * sending.MOST_AT_ONCE)]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    Writer(tmp_path).rows(row_at(10**6)).loggers.end(finished=False)
    assert steps(fake.opened) == [*(row["env_steps"] for row in rows), 10**6]


def test_a_logger_that_cannot_be_opened_and_a_damaged_file_stop_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(run: Logged) -> Fake:
        raise SystemExit("log in first")

    monkeypatch.setattr(sending, "OPENERS", {"wandb": ("json", fails)})
    choose(tmp_path, ("wandb",))
    Writer(tmp_path).rows(row_at(10), row_at(20)).loggers.end(finished=True)
    assert capsys.readouterr().err.count("the logger wandb failed") == 1
    (tmp_path / "loggers.json").write_text("{")
    Writer(tmp_path).rows(row_at(30)).loggers.end(finished=True)
    assert "cannot be read" in capsys.readouterr().err


def test_without_loggers_nothing_is_written_or_opened(tmp_path: Path, fake: type[Fake]) -> None:
    choose(tmp_path, ())
    Writer(tmp_path).rows(row_at(10)).loggers.end(finished=True)
    assert chosen(tmp_path) == {}
    assert fake.opened == []
    assert not (tmp_path / "loggers.json").exists()


def test_a_library_that_is_missing_is_named_with_its_command(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sending, "OPENERS", {"mlflow": ("no_such_module", Fake)})
    with pytest.raises(ConfigError, match=r"pip install 'race-marl\[mlflow\]'"):
        refuse_missing(["mlflow"])


def session(path: Path, *rows: dict[str, Any], kept: int = 0, finished: bool = False) -> None:
    """A session of a run whose checkpoint knew of some rows."""
    writer = Writer(path)
    if writer.file.exists():
        writer.keep(kept)
    pictures = {}
    if finished:
        picture = path / "curve.png"
        iio.imwrite(picture, np.full((20, 30, 3), 200, np.uint8))
        pictures = {"curves/return_mean": picture}
    writer.rows(*rows).loggers.end(finished=finished, pictures=pictures)


def two_sessions(path: Path, name: Any) -> None:
    """Rows at 10 to 40, interrupted after 30 and resumed from 10."""
    path.mkdir(parents=True)
    choose(path, (name,))
    session(path, row_at(10), row_at(20), row_at(30))
    session(path, row_at(20), row_at(30), row_at(40), kept=1, finished=True)


def events(folder: Path) -> list[Any]:
    """What TensorBoard would read: records of length, checksum, content, checksum."""
    from tensorboardX.proto import event_pb2

    found = []
    for file in sorted(folder.glob("events.*")):
        content = file.read_bytes()
        while content:
            (length,) = struct.unpack("<Q", content[:8])
            found.append(event_pb2.Event.FromString(content[12 : 12 + length]))
            content = content[16 + length :]
    return found


def test_tensorboard_has_each_point_once(tmp_path: Path) -> None:
    pytest.importorskip("tensorboardX")
    two_sessions(tmp_path / "race" / "seed3", "tensorboard")
    found = events(tmp_path / "race" / "seed3" / "tensorboard")
    # Files of two sessions within a second have no order.
    points = sorted(
        (event.step, value.simple_value)
        for event in found
        for value in event.summary.value
        if value.tag == "loss/critic"
    )
    assert [step for step, _ in points] == [10, 20, 30, 40]
    assert [value for _, value in points] == pytest.approx([0.1, 0.05, 1 / 30, 0.025])
    others = {value.tag for event in found for value in event.summary.value}
    assert {"curves/return_mean", "settings/text_summary"} <= others


def records(content: bytes) -> list[bytes]:
    """What W&B would upload: its files are LevelDB logs, blocks of 32 kB with records in parts."""
    found, parts, at = [], b"", 7
    while at + 7 <= len(content):
        left = 32768 - at % 32768
        if left < 7:
            at += left
            continue
        length, kind = struct.unpack("<HB", content[at + 4 : at + 7])
        parts += content[at + 7 : at + 7 + length]
        at += 7 + length
        if kind in (1, 4):  # whole, or the last part
            found.append(parts)
            parts = b""
    return found


@pytest.mark.slow
def test_wandb_has_each_point_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    path = tmp_path / "race" / "seed3"
    two_sessions(path, "wandb")
    from wandb.proto import wandb_internal_pb2

    steps_of, ids, tags = [], set(), set()
    for file in sorted(path.glob("wandb/offline-run-*/*.wandb")):
        for data in records(file.read_bytes()):
            record = wandb_internal_pb2.Record.FromString(data)
            if record.HasField("run"):
                ids.add(record.run.run_id)
                tags |= set(record.run.tags)
            if record.HasField("history"):
                items = {"/".join(i.nested_key) or i.key: i.value_json for i in record.history.item}
                if "loss/critic" in items:
                    steps_of.append((record.history.step.num, float(items["loss/critic"])))
    assert [step for step, _ in steps_of] == [10, 20, 30, 40]
    assert steps_of[0][1] == 0.1
    assert ids == {chosen(path)["wandb"]["id"]}
    assert {"task: probe/target", "seed: 3"} <= tags


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_mlflow_has_each_point_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mlflow")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{tmp_path / 'mlflow.db'}")
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "race" / "seed3"
    two_sessions(path, "mlflow")
    from mlflow.tracking import MlflowClient

    client = MlflowClient()
    kept = chosen(path)["mlflow"]["id"]
    history = client.get_metric_history(kept, "loss/critic")
    assert sorted((point.step, point.value) for point in history) == [
        (10, 0.1), (20, 0.05), (30, 1 / 30), (40, 0.025)
    ]  # fmt: skip
    run = client.get_run(kept)
    assert run.info.status == "FINISHED"
    assert run.data.tags["method"] == "RACE(MATD3)"
    assert run.data.params["race.population_size"] == str(CONFIG.race.population_size)
    assert set(run.data.params) <= set(_names(configs.to_json(CONFIG)))
    assert [file.path for file in client.list_artifacts(kept)] == ["curve.png"]


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_trackio_has_each_point_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRACKIO_DIR", str(tmp_path / "trackio"))
    pytest.importorskip("trackio")
    path = tmp_path / "race" / "seed3"
    two_sessions(path, "trackio")
    (file,) = (tmp_path / "trackio").glob("race*.db")
    with sqlite3.connect(file) as base:
        found = base.execute("SELECT step, metrics FROM metrics ORDER BY id").fetchall()
    points = [(step, json.loads(told)) for step, told in found]
    assert [(s, told["loss/critic"]) for s, told in points if "loss/critic" in told] == [
        (10, 0.1), (20, 0.05), (30, 1 / 30), (40, 0.025)
    ]  # fmt: skip


def _names(values: dict[str, Any], before: str = "") -> list[str]:
    return [
        name
        for key, value in values.items()
        for name in (
            _names(value, f"{before}{key}.") if isinstance(value, dict) else [before + key]
        )
    ]
