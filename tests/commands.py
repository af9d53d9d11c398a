"""The command line, called as a user calls it."""

import re

import pytest

from race.cli import main


def race(command: str) -> None:
    main(command.split())


def alone(options: str) -> str:
    """Options without those of a population, which methods without one refuse."""
    return re.sub(r"--(race\.\S+|facmac\.value-size)( (?!--)\S+)*", "", options)


def fails(command: str, capsys: pytest.CaptureFixture[str]) -> str:
    """Runs a command that must fail with a message; returns it."""
    with pytest.raises(SystemExit) as stopped:
        race(command)
    assert stopped.value.code in (1, 2)
    error = capsys.readouterr().err
    assert "Traceback" not in error
    return " ".join(error.split())
