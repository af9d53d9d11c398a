"""Looking at somebody else's run: nothing of theirs is run, nor does it reach the terminal."""

import json
import sys
from pathlib import Path

import pytest

from race.cli import main
from race.config.presets import resolve
from race.config.settings import Config
from race.runs import directory as run_directory
from race.runs.metrics import MetricsWriter


def test_a_look_runs_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    Path("theirs.py").write_text("raise SystemExit('it was run')\n")
    path = tmp_path / "[bold]run"
    run_directory.create(path, resolve(Config("theirs:task")))
    metadata = json.loads((path / "metadata.json").read_text())
    metadata |= {"started": "\x1b[2Jnow", "command": ["race", "\x1b]0;title\x07", 3], "race": None}
    (path / "metadata.json").write_text(json.dumps(metadata))
    with MetricsWriter(path / "metrics.jsonl", run=run_directory.identity_of(path)) as writer:
        writer.write({"kind": "evaluation", "env_steps": 7, "wall_seconds": 1.0})
        writer.write({"kind": "note", "env_steps": "many", "note": "\x1b[31m[/red]"})
    before = {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}
    main(["show", str(path)])
    said = capsys.readouterr().out
    assert "RACE(MATD3) on theirs:task, seed 1" in said
    assert "import the module theirs" in said
    assert "not finished, 0 of" in said
    assert "[/red]" in said
    assert "\\x1b[2Jnow" in said
    assert all(character.isprintable() or character == "\n" for character in said)
    main(["show", str(path), "--json", "--rows", "1"])
    shown = json.loads(capsys.readouterr().out)
    assert [row["kind"] for row in shown["rows"]] == ["note"]
    assert shown["config"]["task"] == "theirs:task"
    assert {file: file.read_bytes() for file in path.rglob("*") if file.is_file()} == before
