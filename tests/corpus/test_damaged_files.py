"""Files that a disk or a hand has changed: refused, or without effect, and never a traceback."""

import contextlib
import dataclasses
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from race.config.presets import resolve
from race.config.settings import (
    CheckpointConfig,
    Config,
    EvaluationConfig,
    LearnerConfig,
)
from race.errors import RaceError
from race.runs import archive, checkpoints
from race.runs import directory as run_directory
from race.runs.results import load, of_directory
from race.teams.trained import load_trained
from race.training.trainer import train
from race.viewing.plotting import plot

OLD = Path(__file__).parents[1] / "training" / "version1"


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two finished runs that differ in their seed, with two checkpoints each."""
    config = Config(
        "bad_tasks:fine",
        algo="matd3",
        env_steps=60,
        learner=LearnerConfig(hidden_sizes=(4, 4), batch_size=4, random_steps=20),
        evaluation=EvaluationConfig(every=20, episodes=2),
        checkpoint=CheckpointConfig(minutes=0.0),
    )
    found = []
    for seed in (1, 2):
        path = tmp_path_factory.mktemp("run") / "run"
        resolved = resolve(dataclasses.replace(config, seed=seed))
        run_directory.create(path, resolved, {"task": "bad"})
        train(path, resolved)
        found.append(path)
    return found[0], found[1]


def contents(path: Path) -> dict[str, bytes]:
    """Every file of a run by its name."""
    files = sorted(file for file in path.rglob("*") if file.is_file() and file.name != ".lock")
    return {str(file.relative_to(path)): file.read_bytes() for file in files}


@contextlib.contextmanager
def changed(file: Path, content: bytes) -> Iterator[None]:
    """A file with another content, for a while."""
    before = file.read_bytes()
    # Checkpoints share files by hard links: another file, so that only this one changes.
    file.unlink()
    file.write_bytes(content)
    try:
        yield
    finally:
        file.write_bytes(before)


DAMAGES = st.tuples(
    st.sampled_from(["flip", "truncate", "swap", "double", "insert"]),
    st.floats(0, 1, exclude_max=True),
    st.floats(0, 1, exclude_max=True),
    st.integers(0, 7),
)


def damaged(content: bytes, damage: tuple[str, float, float, int]) -> bytes:
    how, first, second, bit = damage
    a, b = int(first * len(content)), int(second * len(content))
    match how:
        case "flip":
            new = bytearray(content)
            if new:
                new[a] ^= 1 << bit
            return bytes(new)
        case "truncate":
            return content[:a]
        case "swap":
            low, high = min(a, b), max(a, b)
            span = min(4, high - low)
            x, y = content[low : low + span], content[high : high + span]
            return content[:low] + y + content[low + span : high] + x + content[high + span :]
        case "double":
            return content[: max(a, b)] + content[min(a, b) :]
    return content[:a] + b'[{"\x00' + content[a:]


def known(path: Path) -> Any:
    """All that readers know of a run, apart from what only tells where it came from."""
    newest = checkpoints.newest(path / "checkpoints")
    assert newest is not None
    saved = checkpoints.load(newest)
    rows = saved.rows["replay"]
    recorded = of_directory(path)
    arrays = {name: array.tobytes() for name, array in saved.arrays.items()}
    columns = {name: column.tobytes() for name, column in rows.columns.items()}
    return recorded.config, recorded.rows, saved.info, arrays, columns


@pytest.mark.parametrize(
    "name", ["config.json", "metrics.jsonl", "manifest.json", "arrays.safetensors", "replay"]
)
def test_damage_is_refused_or_without_effect(runs: tuple[Path, Path], name: str) -> None:
    path, _ = runs
    newest = checkpoints.newest(path / "checkpoints")
    assert newest is not None
    (file,) = [f for f in (*path.iterdir(), *newest.iterdir()) if f.name.startswith(name)]
    expected, content = known(path), file.read_bytes()
    outcomes = set()

    @settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
    @given(DAMAGES)
    def check(damage: tuple[str, float, float, int]) -> None:
        with changed(file, damaged(content, damage)):
            try:
                found = known(path)
            except RaceError as error:
                assert str(path) in str(error)  # noqa: PT017
                outcomes.add("refused")
            else:
                assert found == expected
                outcomes.add("without effect")

    check()
    assert "refused" in outcomes
    assert known(path) == expected


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(DAMAGES)
def test_damaged_metadata_are_no_obstacle(
    runs: tuple[Path, Path], damage: tuple[str, float, float, int]
) -> None:
    file = runs[0] / "metadata.json"
    with changed(file, damaged(file.read_bytes(), damage)), contextlib.suppress(RaceError):
        found = of_directory(runs[0])
        assert isinstance(found.algorithm_version, int)
        archive.thinned(found.rows)


def mixtures() -> list[str]:
    return ["config.json", "metrics.jsonl", "checkpoints"]


@pytest.mark.parametrize("part", mixtures())
def test_parts_of_another_run_are_refused(
    runs: tuple[Path, Path], part: str, tmp_path: Path
) -> None:
    mine, other = runs
    mixed = Path(shutil.copytree(mine, tmp_path / "mixed"))
    if (mixed / part).is_dir():
        shutil.rmtree(mixed / part)
        shutil.copytree(other / part, mixed / part)
    else:
        shutil.copy(other / part, mixed / part)
    uses: list[Callable[[Path], Any]] = [lambda path: train(path, run_directory.open_run(path))]
    uses += [load_trained] if part != "metrics.jsonl" else []
    uses += [of_directory] if part != "checkpoints" else []
    # The run has finished, which would refuse training as well.
    (mixed / "DONE").unlink()
    before = contents(mixed)
    for use in uses:
        with pytest.raises(RaceError, match=r"another run|not those that were there"):
            use(mixed)
    assert contents(mixed) == before


@pytest.mark.parametrize("name", ["config.json", "metrics.jsonl", "metadata.json"])
def test_damaged_old_runs_are_no_traceback(name: str, tmp_path: Path) -> None:
    """They have no seals: a change may have an effect, but every reader gets through."""
    path = Path(shutil.copytree(OLD, tmp_path / "old"))
    content = (path / name).read_bytes()

    @settings(max_examples=80, deadline=None, suppress_health_check=list(HealthCheck))
    @given(DAMAGES)
    def check(damage: tuple[str, float, float, int]) -> None:
        with changed(path / name, damaged(content, damage)), contextlib.suppress(RaceError):
            recorded = of_directory(path)
            archive.write(tmp_path / "a.jsonl.gz", [recorded])
            load([tmp_path / "a.jsonl.gz"])

    check()


ABSURD = st.one_of(
    st.none(),
    st.booleans(),
    st.text(max_size=3),
    st.integers(),
    st.floats(),
    st.sampled_from([10**30, -1, 1e308, -1e308, 2**53, "nan", [], {}, [1], {"a": 1}]),
)


def test_absurd_rows_are_refused_or_drawn(tmp_path: Path) -> None:
    path = Path(shutil.copytree(OLD, tmp_path / "old"))
    lines = (path / "metrics.jsonl").read_text().splitlines()
    rows = [json.loads(line) for line in lines]
    keys = sorted({key for row in rows for key in row} - {"kind"})

    @settings(max_examples=12, deadline=None, suppress_health_check=list(HealthCheck))
    @given(st.integers(0, len(rows) - 1), st.sampled_from(keys), ABSURD)
    def check(number: int, key: str, value: Any) -> None:
        new = [dict(row) for row in rows]
        new[number][key] = value
        text = "".join(json.dumps(row) + "\n" for row in new)
        with changed(path / "metrics.jsonl", text.encode()), contextlib.suppress(RaceError):
            for axis in ("env_steps", "wall_time"):
                plot([path], tmp_path / "a.svg", axis=axis)  # type: ignore[arg-type]

    check()
    assert not list(tmp_path.glob(".tmp*"))


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(DAMAGES)
def test_damaged_archives_are_refused_or_whole(
    tmp_path_factory: pytest.TempPathFactory, damage: tuple[str, float, float, int]
) -> None:
    folder = tmp_path_factory.mktemp("archive")
    file = folder / "a.jsonl.gz"
    archive.write(file, load([OLD]))
    expected = [(run.config, run.rows) for run in load([file])]
    file.write_bytes(damaged(file.read_bytes(), damage))
    with contextlib.suppress(RaceError):
        assert [(run.config, run.rows) for run in load([file])] == expected


def test_a_damaged_file_is_found_by_these_means(runs: tuple[Path, Path]) -> None:
    """The helpers above do damage, and notice it."""
    file = runs[0] / "metrics.jsonl"
    content = file.read_bytes()
    flips = [damaged(content, ("flip", place, 0.0, 2)) for place in np.linspace(0, 0.99, 7)]
    assert all(flip != content and len(flip) == len(content) for flip in flips)
    with changed(file, content.replace(b"1", b"2", 1)), pytest.raises(RaceError):
        known(runs[0])
