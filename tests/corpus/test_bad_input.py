"""The corpus: bad input in one process, each with its exit code and its words."""

import ast
import dataclasses
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import table
from table import Case

from race.cli import main
from race.cli import train as train_command
from race.cli.train import Train
from race.runs import metadata

WRONG_BLAME = (
    *("Traceback", "learning rate", "smaller networks", "site-packages", "have diverged"),
    *("gymnasium/", "jaxlib"),
)
FLOATS = ("step_seconds", "mutation_fraction", "vmm_weight")
FILES = {
    "broken_module.py": "def task(:\n",
    "exiting_module.py": "import sys\n\nsys.exit(0)\n",
    "needy_module.py": "import no_such_thing\n",
    "file": "",
}


@pytest.fixture(scope="module", autouse=True)
def quick() -> Iterator[None]:
    """Facts of the machine are looked up once, and the command line is read without its parser.

    The parser takes longer than everything else here; its own refusals are cases of their own.
    """
    facts = metadata.metadata({})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("race.runs.directory.metadata", lambda told: facts | {"environment": told})
        yield


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path.copy())
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    (tmp_path / "loop").symlink_to("loop")
    return tmp_path


def read_quickly(arguments: list[str]) -> Train:
    """What the parser would make of well-formed options."""
    chosen: Any = Train(task=arguments[0])
    options: list[list[str]] = []
    for word in arguments[1:]:
        if word.startswith("--"):
            options.append([word.removeprefix("--").replace("-", "_")])
        else:
            options[-1].append(word)
    for name, *words in options:
        values = tuple(map(_value, words)) or (True,)
        group, _, setting = name.rpartition(".")
        old = getattr(getattr(chosen, group) if group else chosen, setting)
        value: Any = values if isinstance(old, tuple) else values[0]
        if setting == "run_dir":
            value = Path(words[0])
        elif isinstance(old, float) or setting in FLOATS:
            value = float(value)
        change = {setting: value}
        if group:
            change = {group: dataclasses.replace(getattr(chosen, group), **change)}
        chosen = dataclasses.replace(chosen, **change)
    return chosen


def _value(word: str) -> Any:
    if word in ("nan", "inf"):
        return float(word)
    try:
        return ast.literal_eval(word)
    except (ValueError, SyntaxError):
        return word


def check(case: Case, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> str:
    """Runs a command and looks at its code and words, which it returns."""
    if not case.parsed:
        monkeypatch.setattr(train_command, "_parse", read_quickly)
    with pytest.raises(SystemExit) as stopped:
        main(case.command.split())
    said = capsys.readouterr()
    message = " ".join((said.err + said.out).split())
    assert stopped.value.code == case.code, message
    for words in case.words:
        assert words in message
    for words in WRONG_BLAME:
        assert words not in message
    if not case.parsed:
        assert said.err.startswith("race train: ")
        assert said.err.count("\n") == 1  # one paragraph
    return message


def not_refused(*_: Any, **__: Any) -> None:
    pytest.fail("nothing has refused it")


EARLY = [*table.SETTINGS, *table.EFFECTLESS, *table.TASKS, *table.TRIED, *table.GAMES, *table.USAGE]


def name_of(case: Case) -> str:
    return case.command.replace("/", ".")[:70]


def test_there_are_many() -> None:
    every = [case.command for case in (*EARLY, *table.LATE)]
    assert len(every) >= 300
    assert len(set(every)) == len(every)


@pytest.mark.parametrize("case", EARLY, ids=name_of)
def test_bad_input_is_told_and_leaves_nothing(
    case: Case,
    place: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("race.cli.training.train", not_refused)
    monkeypatch.setattr("race.cli.fleet.run_all", not_refused)
    before = set(place.iterdir())
    check(case, capsys, monkeypatch)
    left = {path for path in place.iterdir() if path.name != "__pycache__"}
    assert left == before


@pytest.mark.parametrize("case", table.LATE, ids=name_of)
def test_what_goes_wrong_in_a_run_is_told(
    case: Case,
    place: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # The first words say where the run is.
    monkeypatch.setattr("race.cli.training.TrainingDisplay", Silent)
    monkeypatch.setattr("race.cli.streams.Tolerant.write", lambda self, text: len(text))
    message = check(case, capsys, monkeypatch)
    if ":third_make" not in case.command:  # before there is anything to begin
        assert "begin again with: race resume" in message
    assert not (place / "run" / "DONE").exists()
    assert not list((place / "run").glob("checkpoints/*"))


class Silent:
    def __init__(self, *_: Any) -> None: ...

    def report(self, *_: Any) -> None: ...

    def __enter__(self) -> "Silent":
        return self

    def __exit__(self, *_: Any) -> None: ...
