import contextlib
import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import tracemalloc
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from race.errors import CheckpointError
from race.runs.checkpoints import Rows, list_checkpoints, load, newest, save
from race.runs.trees import flatten, restore

SEGMENT = 4


class State(NamedTuple):
    net: eqx.Module
    optimiser: Any
    keys: jax.Array
    other: dict[str, Any]


def make_state(seed: int) -> State:
    keys = jax.random.split(jax.random.key(seed), 3)
    net = eqx.nn.MLP(2, 3, 4, 1, key=keys[0])
    optimiser = optax.adam(1e-3)
    weights = eqx.filter(net, eqx.is_array)
    # optax itself mixes dtypes, which the tests forbid in this project's own code.
    with jax.numpy_dtype_promotion("standard"):
        moments = optimiser.update(jax.tree.map(jnp.sin, weights), optimiser.init(weights))[1]
    other = {
        "bfloat16": jnp.array([1.5, seed, -0.0], jnp.bfloat16),
        "float32": jnp.array([jnp.nan, jnp.inf, -0.0, 1e-45, seed], jnp.float32),
        "int": jnp.arange(3) - seed,
        "uint": jnp.array(4_000_000_000 + seed, jnp.uint32),
        "bool": jnp.array([[True], [False]]),
        "host": [np.array([1 / 3, seed]), np.int64(seed), np.zeros((0, 2), np.uint8)],
        "raw key": jax.random.PRNGKey(seed),
        "strided": np.arange(6.0).reshape(2, 3).T,
        "none": None,
    }
    return State(net, moments, keys, other)


def assert_same(left: Any, right: Any) -> None:
    assert jax.tree.structure(left) == jax.tree.structure(right)
    for a, b in zip(jax.tree.leaves(left), jax.tree.leaves(right), strict=True):
        if callable(a):
            assert a is b
            continue
        assert type(a) is type(b)
        if isinstance(a, jax.Array) and jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            assert jax.random.key_impl(a) == jax.random.key_impl(b)
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        assert (a.dtype, a.shape) == (b.dtype, b.shape)
        assert np.asarray(a).tobytes() == np.asarray(b).tobytes()


def ring(inserted: int, capacity: int) -> Rows:
    """A buffer in which the row inserted i-th holds i, so that contents tell their age."""
    values = np.zeros((capacity, 2), np.float32)
    flags = np.zeros(capacity, np.uint8)
    for i in range(inserted):
        values[i % capacity] = (i, -i)
        flags[i % capacity] = i % 2
    return Rows({"value": values, "flag": flags}, inserted, capacity)


def write(folder: Path, number: int, inserted: int = 10, capacity: int = 16, keep: int = 9) -> Path:
    return save(
        folder,
        f"step-{number:06d}",
        {"a": np.full(3, number)},
        {"number": number},
        {"replay": ring(inserted, capacity)},
        keep,
        SEGMENT,
    )


def segments(path: Path) -> dict[str, int]:
    return {p.name: p.stat().st_ino for p in path.glob("replay-*")}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "run" / "checkpoints"


# --- pytrees ---


def test_a_pytree_comes_back_bit_for_bit(folder: Path) -> None:
    state = make_state(1)
    save(folder, "step-1", flatten(state), {}, {}, 1)
    assert_same(restore(make_state(2), load(folder / "step-1").arrays), state)


def test_a_restored_key_draws_the_same_numbers() -> None:
    for impl in ("threefry2x32", "rbg"):
        key = jax.random.key(3, impl=impl)
        again = restore({"k": jax.random.key(0, impl=impl)}, flatten({"k": key}))["k"]
        assert jax.random.bits(again).item() == jax.random.bits(key).item()


@pytest.mark.parametrize(
    ("saved", "told"),
    [
        ({"a": np.zeros(2, np.float32)}, "'b'"),
        ({"a": np.zeros(2, np.float32), "b": np.zeros(1), "c": np.zeros(1)}, "'c'"),
        ({"a": np.zeros(3, np.float32), "b": np.zeros(1)}, r"'a'.*float32\[3\].*float32\[2\]"),
        ({"a": np.zeros(2, np.float16), "b": np.zeros(1)}, r"'a'.*float16\[2\].*float32\[2\]"),
    ],
)
def test_restore_names_the_leaf_that_differs(saved: Any, told: str) -> None:
    template = {"a": np.ones(2, np.float32), "b": np.ones(1)}
    with pytest.raises(CheckpointError, match=told):
        restore(template, flatten(saved))


@pytest.mark.parametrize("leaf", [1, 1.0, True, "text", np.array(["text"]), np.zeros(1, complex)])
def test_leaves_that_cannot_be_stored_exactly_are_refused(leaf: Any) -> None:
    with pytest.raises(TypeError, match="'a'"):
        flatten({"a": leaf})


# --- tables ---


@settings(max_examples=40, deadline=None)
@given(
    capacity=st.integers(1, 19),
    steps=st.lists(st.integers(0, 25), min_size=1, max_size=4),
)
def test_any_sequence_of_checkpoints_loads_what_was_saved(
    tmp_path_factory: pytest.TempPathFactory, capacity: int, steps: list[int]
) -> None:
    folder = tmp_path_factory.mktemp("any")
    inserted = 0
    for number, more in enumerate(steps):
        inserted += more
        path = write(folder, number, inserted, capacity)
        rows, expected = load(path).rows["replay"], ring(inserted, capacity)
        assert (rows.inserted, rows.capacity) == (inserted, capacity)
        for name, column in expected.columns.items():
            np.testing.assert_array_equal(rows.columns[name], column)


def test_unchanged_segments_are_linked_and_changed_ones_are_written(folder: Path) -> None:
    first = segments(write(folder, 1, inserted=10))
    second = segments(write(folder, 2, inserted=14))
    assert set(first) == {f"replay-0000{s}-{v}.safetensors" for s, v in [(0, 4), (1, 8), (2, 10)]}
    assert set(second) - set(first) == {
        "replay-00002-12.safetensors",
        "replay-00003-14.safetensors",
    }
    for name in ("replay-00000-4.safetensors", "replay-00001-8.safetensors"):
        assert second[name] == first[name]
    # Row 17 wraps around: it overwrites places 0 and 1, and 2 rows fill the last segment.
    third = segments(write(folder, 3, inserted=18))
    assert set(third) - set(second) == {
        "replay-00000-18.safetensors",
        "replay-00003-16.safetensors",
    }
    assert {n: third[n] for n in set(third) & set(second)}.items() <= second.items()
    # A lap later nothing is the same.
    assert not set(segments(write(folder, 4, inserted=34))) & set(third)


def test_segments_are_copied_where_links_are_impossible(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = segments(write(folder, 1))

    def refuse(*_: Any) -> None:
        raise OSError(errno.EPERM, "no links here")

    monkeypatch.setattr(os, "link", refuse)
    path = write(folder, 2)
    assert set(segments(path)) == set(first)
    assert not set(segments(path).values()) & set(first.values())
    np.testing.assert_array_equal(
        load(path).rows["replay"].columns["value"], ring(10, 16).columns["value"]
    )


def test_a_segment_of_another_layout_is_not_linked(folder: Path) -> None:
    write(folder, 1)
    wide = Rows({"value": np.ones((16, 3), np.float32)}, 10, 16)
    path = save(folder, "step-2", {}, {}, {"replay": wide}, 2, SEGMENT)
    assert load(path).rows["replay"].columns["value"][:10].tolist() == [[1, 1, 1]] * 10


def test_a_truncated_segment_is_written_again_instead_of_linked(folder: Path) -> None:
    damaged = write(folder, 1) / "replay-00000-4.safetensors"
    os.truncate(damaged, damaged.stat().st_size - 1)
    load(write(folder, 2))


def test_jax_columns_are_saved_like_numpy_ones(folder: Path) -> None:
    numpy = ring(10, 16)
    columns = {name: jnp.asarray(column) for name, column in numpy.columns.items()}
    path = save(folder, "step-1", {}, {}, {"replay": Rows(columns, 10, 16)}, 1, SEGMENT)
    loaded = load(path).rows["replay"]
    for name, column in numpy.columns.items():
        np.testing.assert_array_equal(loaded.columns[name], column)


def test_saving_needs_memory_for_about_one_segment(folder: Path) -> None:
    length, width = 2_000, 100
    rows = Rows({"x": np.ones((8 * length, width), np.float32)}, 8 * length, 8 * length)
    tracemalloc.start()
    try:
        save(folder, "step-1", {}, {}, {"replay": rows}, 1, length)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 1.5 * length * width * 4


def test_rows_cannot_be_fewer_than_are_filled() -> None:
    with pytest.raises(ValueError, match="x"):
        Rows({"x": np.zeros(3)}, inserted=4, capacity=8)


# --- which checkpoints there are ---


def test_the_newest_is_the_largest_number(folder: Path) -> None:
    assert newest(folder) is None
    for name in ("step-9", "step-10", "step-000000000002"):
        save(folder, name, {}, {}, {}, 9)
    (folder / "step-99").write_text("a file")
    (folder / "notes").mkdir()
    (folder / ".tmp-step-100-1").mkdir()
    names = [p.name for p in list_checkpoints(folder)]
    assert names == ["step-000000000002", "step-9", "step-10"]
    assert newest(folder) == folder / "step-10"


def test_the_newest_keep_remain(folder: Path) -> None:
    for number in range(1, 6):
        write(folder, number, inserted=4 * number, keep=2)
    assert sorted(p.name for p in folder.iterdir()) == ["step-000004", "step-000005"]
    for path in list_checkpoints(folder):
        load(path)


def test_a_number_saved_again_counts_as_newer_and_overwrites_nothing(folder: Path) -> None:
    first = save(folder, "step-1", {"a": np.array(1)}, {}, {}, 2)
    second = save(folder, "step-1", {"a": np.array(2)}, {}, {}, 2)
    assert newest(folder) == second != first
    assert load(first).arrays["a"] == 1
    assert load(second).arrays["a"] == 2
    third = save(folder, "step-1", {"a": np.array(3)}, {}, {}, 2)
    assert list_checkpoints(folder) == [second, third]


def test_a_new_checkpoint_stays_even_if_a_larger_number_lies_there(folder: Path) -> None:
    write(folder, 9)
    path = write(folder, 5, keep=1)
    assert load(path).info == {"number": 5}


@pytest.mark.parametrize(("name", "keep"), [("step", 1), ("step-1.1", 1), ("a/b-1", 1), ("s-1", 0)])
def test_names_and_counts_that_make_no_sense_are_refused(
    folder: Path, name: str, keep: int
) -> None:
    with pytest.raises(ValueError, match="keep"):
        save(folder, name, {}, {}, {}, keep)


def test_info_comes_back(folder: Path) -> None:
    info = {"float": 0.1 + 0.2, "big": 2**70, "list": [None, True, {"é": "\n"}], "low": -np.inf}
    save(folder, "step-1", {}, info, {}, 1)
    assert load(folder / "step-1").info == info


def test_info_that_json_cannot_hold_leaves_nothing_behind(folder: Path) -> None:
    with pytest.raises(TypeError):
        save(folder, "step-1", {}, {"path": Path()}, {}, 1)
    assert list(folder.iterdir()) == []


# --- damage ---


@pytest.mark.parametrize(
    "file", ["manifest.json", "arrays.safetensors", "replay-00001-8.safetensors"]
)
def test_any_changed_byte_is_detected(folder: Path, file: str) -> None:
    path = write(folder, 1)
    intact = (path / file).read_bytes()
    for place in {0, 1, 7, 8, 9, *range(10, len(intact), 37), len(intact) - 1}:
        for flip in (1, 32):
            damaged = bytearray(intact)
            damaged[place] ^= flip
            (path / file).write_bytes(damaged)
            with pytest.raises(CheckpointError):
                load(path)
    (path / file).write_bytes(intact)
    load(path)


@pytest.mark.parametrize("file", ["manifest.json", "arrays.safetensors"])
def test_truncated_and_missing_files_are_detected(folder: Path, file: str) -> None:
    path = write(folder, 1)
    intact = (path / file).read_bytes()
    for content in (b"", intact[: len(intact) // 2], intact[:-1], intact + b"\0"):
        (path / file).write_bytes(content)
        with pytest.raises(CheckpointError, match=file):
            load(path)
    (path / file).unlink()
    with pytest.raises(CheckpointError, match=file):
        load(path)


def test_the_message_names_the_next_older_intact_checkpoint(folder: Path) -> None:
    paths = [write(folder, number, inserted=4 * number) for number in (1, 2, 3)]
    for path in paths[1:]:
        (path / "arrays.safetensors").write_bytes(b"")
    with pytest.raises(CheckpointError) as caught:
        load(paths[2])
    message = str(caught.value)
    assert str(paths[2]) in message
    assert str(paths[0]) in message
    assert str(paths[1]) not in message
    assert f"`race resume {folder.parent}`" in message
    (paths[0] / "manifest.json").unlink()
    with pytest.raises(CheckpointError, match="no older intact"):
        load(paths[2])


def test_foreign_folders_and_versions_are_refused(folder: Path) -> None:
    with pytest.raises(CheckpointError, match="no such folder"):
        load(folder / "step-1")
    path = write(folder, 1)
    manifest = json.loads((path / "manifest.json").read_text())
    for change, told in (
        ({"format": "other"}, "another program"),
        ({"version": 2}, "format version 2"),
    ):
        (path / "manifest.json").write_text(json.dumps({**manifest, **change}))
        with pytest.raises(CheckpointError, match=told):
            load(path)
    for text in ("[]", "null", "{}", "not JSON", "\xff"):
        (path / "manifest.json").write_text(text, encoding="latin-1")
        with pytest.raises(CheckpointError, match=r"manifest\.json"):
            load(path)


# --- interruption ---


class KilledError(BaseException):
    """Stands for the end of the process: from then on no call reaches the disk."""


def test_a_kill_at_any_system_call_leaves_an_intact_checkpoint(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reached = []
    for deadline in range(100):
        shutil.rmtree(folder, ignore_errors=True)
        write(folder, 1, inserted=10, keep=1)
        calls = 0

        def watch(module: Any, name: str, deadline: int = deadline) -> None:
            original = getattr(module, name)

            def wrapper(*args: Any, **kwargs: Any) -> Any:
                nonlocal calls
                calls += 1
                if calls > deadline:
                    raise KilledError
                return original(*args, **kwargs)

            patch.setattr(module, name, wrapper)

        with monkeypatch.context() as patch, contextlib.suppress(KilledError):
            for module, name in [
                (os, "fsync"),
                (os, "rename"),
                (os, "link"),
                (os, "mkdir"),
                (shutil, "rmtree"),
            ]:
                watch(module, name)
            write(folder, 2, inserted=18, keep=1)
        path = newest(folder)
        assert path is not None
        number = load(path).info["number"]
        reached.append(number)
        assert load(path).arrays["a"].tolist() == [number] * 3
        assert load(path).rows["replay"].inserted == {1: 10, 2: 18}[number]
        # The next save clears up.
        write(folder, 3, inserted=20, keep=1)
        assert [p.name for p in folder.iterdir()] == ["step-000003"]
        if calls <= deadline:
            break
    assert reached == sorted(reached)
    assert set(reached) == {1, 2}
    assert len(reached) > 8


def test_a_kill_while_deleting_leaves_no_half_checkpoint(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(folder, 1, keep=2)
    write(folder, 2, keep=2)

    def delete_some(path: Path, **_: Any) -> None:
        if path.exists():
            (path / "arrays.safetensors").unlink(missing_ok=True)
            raise KilledError

    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", delete_some)
        with pytest.raises(KilledError):
            write(folder, 3, keep=2)
    assert [load(path).info["number"] for path in list_checkpoints(folder)] == [2, 3]
    write(folder, 4, keep=2)
    assert sorted(p.name for p in folder.iterdir()) == ["step-000003", "step-000004"]


@pytest.mark.parametrize("broken", ["fsync", "rename", "mkdir"])
def test_a_full_disk_leaves_the_checkpoints_before_untouched(
    folder: Path, monkeypatch: pytest.MonkeyPatch, broken: str
) -> None:
    path = write(folder, 1, keep=1)
    before = {p.name: p.read_bytes() for p in path.iterdir()}

    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, broken, full)
        with pytest.raises(CheckpointError, match=r"No space left.*MB.*MB are free") as caught:
            write(folder, 2, keep=1)
    assert f"`race resume {folder.parent}`" in str(caught.value)
    assert list(folder.iterdir()) == [path]
    assert {p.name: p.read_bytes() for p in path.iterdir()} == before
    load(write(folder, 2, keep=1))


def test_a_write_that_the_system_refuses_is_told_too(folder: Path) -> None:
    resource = pytest.importorskip("resource")
    path = write(folder, 1)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))
    try:
        with pytest.raises(CheckpointError, match="could not be written"):
            save(folder, "step-2", {"a": np.zeros(100_000)}, {}, {}, 1)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(folder.iterdir()) == [path]


def test_a_checkpoint_folder_that_cannot_be_made_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(CheckpointError, match="could not be written"):
        save(tmp_path / "file" / "checkpoints", "step-1", {}, {}, {}, 1)


SAVES_FOREVER = """
import sys
from pathlib import Path
import numpy as np
from race.runs.checkpoints import Rows, save
values = np.zeros((4000, 8), np.float32)
for number in range(1, 1_000_000):
    values[(number - 1) % 4000] = number
    rows = {"replay": Rows({"value": values}, number, 4000)}
    save(Path(sys.argv[1]), f"step-{number}", {"a": np.full(20_000, number)}, {}, rows, 1, 1000)
    if number == 1:
        print("started", flush=True)
"""


def test_a_killed_process_leaves_an_intact_checkpoint(folder: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", SAVES_FOREVER, str(folder)], stdout=subprocess.PIPE
    )
    assert process.stdout is not None
    with process.stdout:
        assert process.stdout.readline() == b"started\n"
        time.sleep(0.25)
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
    path = newest(folder)
    assert path is not None
    checkpoint = load(path)
    number = checkpoint.rows["replay"].inserted
    assert path.name == f"step-{number}"
    assert number > 1
    assert checkpoint.arrays["a"].tolist() == [number] * 20_000
    filled = checkpoint.rows["replay"].columns["value"][:number, 0]
    assert filled.tolist() == list(range(1, number + 1))
