import errno
import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from race.errors import RunDirectoryError
from race.runs import metrics
from race.runs.metrics import Extent, MetricsWriter, read


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "metrics.jsonl"


def write(path: Path, *numbers: int, offset: int | None = None) -> int:
    with MetricsWriter(path, None if offset is None else Extent(offset)) as writer:
        for number in numbers:
            writer.write({"n": number})
        return writer.offset


def numbers(path: Path) -> list[int]:
    return [row["n"] for row in read(path)]


def test_rows_come_back_in_order_and_each_is_one_line(path: Path) -> None:
    rows = [{"kind": "note", "text": "two\nlines é", "nested": {"a": [1, None]}}, {}]
    with MetricsWriter(path) as writer:
        for row in rows:
            writer.write(row)
            # Visible to other processes at once.
            assert read(path)[-1] == row
    assert read(path) == rows
    assert path.read_bytes().count(b"\n") == 2


def test_numbers_keep_their_exact_value(path: Path) -> None:
    third = np.float32(1) / np.float32(3)
    with MetricsWriter(path) as writer:
        writer.write(
            {
                "double": 0.1 + 0.2,
                "single": third,
                "array": np.array([third, 2], np.float32),
                "jax": jnp.array(third),
                "matrix": jnp.ones((2, 1), jnp.int32),
                "int": np.int64(2**53 - 1),
                "bool": np.bool_(True),
                "tuple": (1, np.uint8(2)),
            }
        )
    row = read(path)[0]
    assert row["double"] == 0.1 + 0.2
    assert row["single"] == row["jax"] == row["array"][0] == float(third) != 1 / 3
    assert row["matrix"] == [[1], [1]]
    assert row["int"] == 2**53 - 1
    assert row["bool"] is True
    assert row["tuple"] == [1, 2]


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_every_finite_float_comes_back_bit_for_bit(value: float) -> None:
    assert (
        json.loads(json.dumps(metrics._plain({"x": np.float64(value)})))["x"].hex() == value.hex()
    )


def test_numbers_that_are_not_finite_become_null(path: Path) -> None:
    with MetricsWriter(path) as writer:
        writer.write({"a": float("nan"), "b": np.float32("inf"), "c": [np.array([1, -np.inf])]})
    assert read(path) == [{"a": None, "b": None, "c": [[1.0, None]]}]


def test_a_row_that_json_cannot_hold_is_refused_and_not_begun(path: Path) -> None:
    with MetricsWriter(path) as writer:
        writer.write({"n": 1})
        with pytest.raises(TypeError):
            writer.write({"n": 2, "path": path})
        writer.write({"n": 3})
    assert numbers(path) == [1, 3]


@given(before=st.integers(0, 5), after=st.integers(0, 5), torn=st.binary(max_size=9))
def test_rows_after_the_checkpoint_are_dropped(
    tmp_path_factory: pytest.TempPathFactory, before: int, after: int, torn: bytes
) -> None:
    path = tmp_path_factory.mktemp("metrics") / "metrics.jsonl"
    offset = write(path, *range(before))
    write(path, *range(100, 100 + after))
    with path.open("ab") as file:
        file.write(torn)
    write(path, 7, offset=offset)
    assert numbers(path) == [*range(before), 7]


def test_offset_is_the_length_of_the_file(path: Path) -> None:
    with MetricsWriter(path) as writer:
        assert writer.offset == 0
        for number in (1, 1000):
            writer.write({"n": number, "é": "é"})
            writer.sync()
            assert writer.offset == path.stat().st_size
    with MetricsWriter(path) as writer:
        assert writer.offset == path.stat().st_size


@pytest.mark.parametrize("tail", [b'{"n"', b'{"n": 5}', b"\0\0\0"])
def test_a_torn_last_line_is_ignored_and_never_continued(path: Path, tail: bytes) -> None:
    write(path, 1, 2)
    with path.open("ab") as file:
        file.write(tail)
    assert numbers(path) == [1, 2]
    write(path, 3)
    assert numbers(path) == [1, 2, 3]


@pytest.mark.parametrize("line", ["{", "", "[1]", "3", '{"n": 1} {"n": 2}', "\xff"])
def test_a_malformed_inner_line_is_named(path: Path, line: str) -> None:
    text = '{"n": 1}\n' + line + '\n{"n": 3}\n'
    path.write_text(text, encoding="latin-1")
    with pytest.raises(RunDirectoryError, match=rf"Line 2 of {path}"):
        read(path)


def test_offsets_that_do_not_fit_the_file_are_refused_and_change_nothing(path: Path) -> None:
    offset = write(path, 1, 2)
    content = path.read_bytes()
    for wrong, told in ((offset + 1, "rows are missing"), (offset - 1, "no end of a row")):
        with pytest.raises(RunDirectoryError, match=told):
            MetricsWriter(path, Extent(wrong))
        assert path.read_bytes() == content


def test_rows_that_were_changed_are_refused_and_stay(path: Path) -> None:
    with MetricsWriter(path, run="abc") as writer:
        for number in (1, 2):
            writer.write({"n": number})
        kept = writer.extent
        writer.write({"n": 3})
    assert read(path, "abc", kept)[0] == {"n": 1, "run": "abc"}
    content = path.read_bytes()
    path.write_bytes(content.replace(b'"n": 2', b'"n": 7'))
    for use in (lambda: read(path, "abc", kept), lambda: MetricsWriter(path, kept, "abc")):
        with pytest.raises(RunDirectoryError, match=r"not those .* resume .* --without-metrics"):
            use()
    path.write_bytes(content.replace(b'"n": 3', b'"n": 7'))  # nobody has vouched for it
    assert read(path, "abc", kept)[2] == {"n": 7}
    with pytest.raises(RunDirectoryError, match=r"another run \(abc\) than .* \(def\)"):
        read(path, "def")
    with MetricsWriter(path, kept, "abc") as writer:
        assert writer.extent == kept
        writer.write({"n": 4})
        grown = writer.extent
        writer.write({"n": 5})
        writer.forget(grown.offset)
        assert writer.extent == grown
    assert [row["n"] for row in read(path, "abc", grown)] == [1, 2, 4]


@pytest.mark.parametrize("value", ["1", 1.5, -1, True, None, 10**30, [1], float("nan")])
def test_steps_that_no_run_makes_are_named(path: Path, value: Any) -> None:
    good = {"kind": "evaluation", "env_steps": 5, "wall_seconds": 0.5}
    for name in ("env_steps", "wall_seconds"):
        if name == "wall_seconds" and value == 1.5:
            continue
        path.write_text(json.dumps(good) + "\n" + json.dumps(good | {name: value}) + "\n")
        with pytest.raises(RunDirectoryError, match=f"Line 2 of .*its {name} are"):
            read(path)
    path.write_text(json.dumps({"kind": "generation"}) + "\n")
    with pytest.raises(RunDirectoryError, match=r"Line 1 of .*its env_steps are None"):
        read(path)


def test_rows_nested_without_end_are_named(path: Path) -> None:
    path.write_text('{"n": ' + "[" * 100_000 + "]" * 100_000 + "}\n")
    with pytest.raises(RunDirectoryError, match=r"Line 1 of .*nested too deeply"):
        read(path)


def test_files_that_cannot_be_opened_are_told(path: Path, tmp_path: Path) -> None:
    with pytest.raises(RunDirectoryError, match="cannot be read"):
        read(path)
    with pytest.raises(RunDirectoryError, match="cannot be opened"):
        MetricsWriter(tmp_path / "missing" / "metrics.jsonl")


def test_a_full_disk_is_told_and_leaves_whole_rows(path: Path) -> None:
    class FullDisk:
        """A file that takes four more bytes."""

        def __init__(self, file: Any) -> None:
            self.file = file

        def write(self, data: bytes) -> int:
            if len(data) > 4:
                return self.file.write(data[:4])
            raise OSError(errno.ENOSPC, "No space left on device")

        def __getattr__(self, name: str) -> Any:
            return getattr(self.file, name)

    with MetricsWriter(path) as writer:
        writer.write({"n": 1})
        writer._file, file = FullDisk(writer._file), writer._file
        with pytest.raises(RunDirectoryError, match="No space left"):
            writer.write({"n": 2})
        writer._file = file
        writer.write({"n": 3})
        assert writer.offset == path.stat().st_size
    assert numbers(path) == [1, 3]


@pytest.mark.parametrize(
    "lines",
    [
        ['{"n": [1', "2]}"],  # one object over two lines
        ['{"n": 1}, {"n": 2}'],  # two objects in one
        ['{"n": [1', '2]}, {"n": 2}, {"n": 3}'],  # both: as many as there are lines
        ['{"n": 1}', "0"],
        ['{"n": 1}', ""],
    ],
)
def test_lines_are_rows_and_nothing_else_is(path: Path, lines: list[str]) -> None:
    path.write_text("\n".join(['{"n": 0}', *lines, ""]))
    with pytest.raises(RunDirectoryError, match=r"Line [23] of .* is no row of metrics"):
        read(path)
