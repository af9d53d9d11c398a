import dataclasses
import importlib.metadata
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import race
from race.config.presets import resolve
from race.config.settings import Config, LearnerConfig
from race.errors import RunDirectoryError
from race.runs import directory as run_directory
from race.runs import metadata
from race.runs.directory import (
    RunDirectory,
    change_config,
    clear_finished,
    create,
    identity_of,
    is_finished,
    lock,
    mark_finished,
    open_run,
)

CONFIG = resolve(Config(task="mamujoco/Ant-2x4", seed=3, learner=LearnerConfig(discount=0.1 + 0.2)))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "runs" / "one"


def test_a_created_run_opens_with_its_configuration(path: Path) -> None:
    run = create(path, CONFIG, {"ids": ["Ant-v5"]})
    assert open_run(path) == CONFIG
    assert run == RunDirectory(path)
    assert sorted(p.name for p in path.iterdir()) == ["config.json", "metadata.json"]


def test_metadata_tells_where_the_run_came_from(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["race", "train", "Ant-2x4", "--seed", "3"])
    create(path, CONFIG, {"ids": ["Ant-v5"]})
    data = json.loads((path / "metadata.json").read_text())
    assert data["race"] == race.__version__
    for name in ("race-marl", "jax", "jaxlib", "mujoco", "numpy", "gymnasium", "safetensors"):
        assert data["versions"][name] == importlib.metadata.version(name)
    assert data["command"] == ["race", "train", "Ant-2x4", "--seed", "3"]
    assert data["environment"] == {"ids": ["Ant-v5"]}
    assert data["backend"] == "cpu"
    assert len(data["devices"]) >= 1
    assert data["processors"] == os.cpu_count()


def test_the_commit_is_recorded_only_for_sources_that_the_checkout_tracks(tmp_path: Path) -> None:
    def git(*arguments: str) -> None:
        who = ["-c", "user.name=a", "-c", "user.email=a@b"]
        subprocess.run(["git", "-C", str(tmp_path), *who, *arguments], check=True)

    source = tmp_path / "package"
    source.mkdir()
    (source / "__init__.py").write_text("")
    assert metadata._git(source) is None
    git("init", "--quiet")
    assert metadata._git(source) is None
    git("add", "package")
    git("commit", "--quiet", "-m", "first")
    found = metadata._git(source)
    assert found is not None
    assert len(found["commit"]) == 40
    assert found["modified"] is False
    (source / "new.py").write_text("")
    assert metadata._git(source) == {**found, "modified": True}


def test_metadata_needs_neither_git_nor_an_installed_distribution(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.setattr(metadata, "DISTRIBUTION", "not-installed-anywhere")
    data = metadata.metadata({})
    assert data["git"] is None
    assert data["versions"] == {}
    assert data["race"] == race.__version__


@pytest.mark.parametrize("part", ["config.json", "metrics.jsonl", "checkpoints"])
def test_a_directory_that_holds_a_run_is_refused_and_unchanged(path: Path, part: str) -> None:
    path.mkdir(parents=True)
    (path / part).write_text("mine")
    with pytest.raises(RunDirectoryError, match=rf"`race resume {path}`.*--run-dir"):
        create(path, CONFIG)
    assert [(p.name, p.read_text()) for p in path.iterdir()] == [(part, "mine")]


def test_of_two_that_create_at_once_the_second_is_refused(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = run_directory.metadata

    def other_is_faster(environment: dict[str, str]) -> dict[str, object]:
        monkeypatch.setattr(run_directory, "metadata", plain)
        create(path, dataclasses.replace(CONFIG, seed=9))
        return plain(environment)

    monkeypatch.setattr(run_directory, "metadata", other_is_faster)
    with pytest.raises(RunDirectoryError, match="already holds a run"):
        create(path, CONFIG)
    assert open_run(path).seed == 9
    assert sorted(p.name for p in path.iterdir()) == ["config.json", "metadata.json"]


def test_a_directory_with_other_files_can_become_a_run(path: Path) -> None:
    path.mkdir(parents=True)
    (path / "notes.txt").write_text("mine")
    create(path, CONFIG)
    assert (path / "notes.txt").read_text() == "mine"


def test_places_where_no_directory_can_be_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(RunDirectoryError, match="is a file"):
        create(tmp_path / "file", CONFIG)
    with pytest.raises(RunDirectoryError, match="cannot be written"):
        create(tmp_path / "file" / "run", CONFIG)
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_directory_without_write_permission_is_refused(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(RunDirectoryError, match="cannot be written"):
        create(tmp_path / "run", CONFIG)


def test_a_kill_while_creating_leaves_no_half_run(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(os, "link", fail)
        with pytest.raises(KeyboardInterrupt):
            create(path, CONFIG)
    assert list(path.iterdir()) == []
    create(path, CONFIG)


def test_folders_that_are_no_run_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for place in (tmp_path, tmp_path / "missing", tmp_path / "file"):
        with pytest.raises(RunDirectoryError, match="not the directory of a run"):
            open_run(place)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "no JSON object"),
        ('{"task": ', "no JSON object"),
        ("\xff", "no JSON object"),
        ("[]", "no JSON object"),
        ("[" * 100_000, "nested too deeply"),
        ('{"a":' * 100_000, "nested too deeply"),
        ('{"task": "a"}', "does not fit"),
    ],
)
def test_a_config_that_cannot_be_read_is_told(tmp_path: Path, text: str, told: str) -> None:
    (tmp_path / "config.json").write_text(text, encoding="latin-1")
    with pytest.raises(RunDirectoryError, match=told):
        open_run(tmp_path)


def unsealed(path: Path) -> dict[str, Any]:
    """The configuration of a run, as versions before seals and identities wrote it."""
    body = json.loads((path / "config.json").read_text())
    assert len(body.pop("digest")) == 32
    assert len(body.pop("run")) == 16
    return dict(body)


def test_each_run_has_an_identity_which_stays(path: Path, tmp_path: Path) -> None:
    create(path, CONFIG)
    create(tmp_path / "two", CONFIG)
    identity = identity_of(path)
    assert identity != identity_of(tmp_path / "two")
    change_config(path, dataclasses.replace(CONFIG, env_steps=7_000_000))
    assert identity_of(path) == identity
    assert open_run(path).env_steps == 7_000_000
    # A run of before stays one.
    (path / "config.json").write_text(json.dumps(unsealed(path)))
    assert identity_of(path) is None
    change_config(path, CONFIG)
    assert identity_of(path) is None


def test_a_config_that_was_changed_by_hand_is_refused(path: Path) -> None:
    create(path, CONFIG)
    text = (path / "config.json").read_text()
    body = json.loads(text)
    changed = [
        text.replace('"seed": 3', '"seed": 4'),
        text.replace('"digest"', '"digset"'),
        json.dumps({k: v for k, v in body.items() if k != "digest"}),
        json.dumps({k: v for k, v in body.items() if k != "run"}),
        json.dumps(body | {"run": "0" * 16}),
    ]
    for other in changed:
        (path / "config.json").write_text(other)
        with pytest.raises(RunDirectoryError, match="changed since race wrote it"):
            open_run(path)
    (path / "config.json").write_text(json.dumps(body))  # as some tools write it
    assert open_run(path) == CONFIG


def test_a_config_with_a_foreign_field_is_told(path: Path) -> None:
    run = create(path, CONFIG)
    data = unsealed(path)
    data["learner"]["momentum"] = 0.9
    run.config.write_text(json.dumps(data))
    with pytest.raises(RunDirectoryError, match="momentum"):
        open_run(path)


def test_finished_can_be_marked_and_taken_back(path: Path) -> None:
    create(path, CONFIG)
    assert not is_finished(path)
    clear_finished(path)
    mark_finished(path)
    assert is_finished(path)
    assert (path / "DONE").exists()
    clear_finished(path)
    assert not is_finished(path)


# --- locks ---

HOLDS = """
import fcntl, sys, time
from pathlib import Path
from typing import Any
from race.runs.directory import lock
with lock(Path(sys.argv[1])):
    print("locked", flush=True)
    time.sleep(60)
"""


def test_a_lock_keeps_others_out_until_it_ends(tmp_path: Path) -> None:
    with lock(tmp_path):
        with pytest.raises(RunDirectoryError, match=rf"\(id {os.getpid()}\)"), lock(tmp_path):
            pytest.fail("locked twice")
        # The refusal did not end the first one's right.
        with pytest.raises(RunDirectoryError), lock(tmp_path):
            pytest.fail("locked twice")
    with lock(tmp_path):
        pass


def test_a_lock_ends_when_its_block_fails(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), lock(tmp_path):
        raise ZeroDivisionError
    with lock(tmp_path):
        pass


def test_the_lock_of_a_killed_process_is_free_again(tmp_path: Path) -> None:
    process = subprocess.Popen([sys.executable, "-c", HOLDS, str(tmp_path)], stdout=subprocess.PIPE)
    assert process.stdout is not None
    with process.stdout:
        assert process.stdout.readline() == b"locked\n"
        with pytest.raises(RunDirectoryError, match=rf"\(id {process.pid}\)"), lock(tmp_path):
            pytest.fail("locked twice")
        process.send_signal(signal.SIGKILL)
        process.wait()
    with lock(tmp_path):
        assert (tmp_path / ".lock").read_text() == f"{os.getpid()}\n"


FORKS_AND_IS_KILLED = """
import os, signal, sys
from pathlib import Path
from typing import Any
from race.runs.directory import lock
with lock(Path(sys.argv[1])):
    if os.fork() == 0:
        print("forked", flush=True)
        sys.stdin.read()
        os._exit(0)
    signal.pause()
"""


def test_a_child_that_outlives_a_killed_process_does_not_keep_the_lock(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", FORKS_AND_IS_KILLED, str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert process.stdin is not None
    assert process.stdout is not None
    with process.stdin, process.stdout:
        assert process.stdout.readline() == b"forked\n"
        with pytest.raises(RunDirectoryError), lock(tmp_path):
            pytest.fail("locked twice")
        process.send_signal(signal.SIGKILL)
        process.wait()
        with lock(tmp_path):
            pass


def test_a_missing_directory_cannot_be_locked(tmp_path: Path) -> None:
    with pytest.raises(RunDirectoryError, match="cannot be locked"), lock(tmp_path / "missing"):
        pytest.fail("locked nothing")


@pytest.mark.parametrize(
    ("group", "name", "value"),
    [
        ("learner", "batch_size", "8"),
        ("learner", "batch_size", 8.5),
        ("learner", "hidden_sizes", [400]),
        ("learner", "discount", True),
        ("race", "vmm_weight", "much"),
        ("env", "local_categories", "qpos"),
        ("evaluation", "episodes", 0),
    ],
)
def test_a_config_with_a_wrong_value_is_refused(
    path: Path, group: str, name: str, value: object
) -> None:
    create(path, CONFIG)
    saved = unsealed(path)
    saved[group][name] = value
    (path / "config.json").write_text(json.dumps(saved))
    with pytest.raises(RunDirectoryError, match=name.replace("_", "[-_]")):
        open_run(path)
