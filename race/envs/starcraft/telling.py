"""What people are told about StarCraft II and SMAC: what to install, and what is wrong."""

import difflib
from collections.abc import Mapping
from typing import Any, Final

SOURCES: Final = {
    "smac": "https://github.com/oxwhirl/smac",
    "smacv2": "https://github.com/oxwhirl/smacv2",
}
INSTALL: Final = (
    "python3.10 -m venv sc2-python && sc2-python/bin/pip install 'pysc2==4.0.0' 'protobuf<3.21' "
    "pyyaml 'git+{source}.git'"
)
"""Versions that go together: newer protobuf refuses what the game's protocol is written with, and
PySC2 draws no pictures with newer Pythons."""
GAME: Final = (
    "StarCraft II 4.10 for Linux (github.com/Blizzard/s2client-proto, Downloads), unpacked, with "
    "SC2PATH set to its folder"
)
MADE: Final = "sc2-python/bin/python"
CHOOSE: Final = "Name the interpreter that has SMAC with --env.python (docs/starcraft.md)."

_NAMES: Final = {"smac": "SMAC", "smacv2": "SMACv2"}


def install(package: str) -> str:
    """The command that makes an interpreter with ``smac`` or ``smacv2``."""
    return INSTALL.format(source=SOURCES[package])


def missing(package: str, python: str, kind: str, facts: Mapping[str, Any]) -> str:
    """What is not installed, and how it is; empty if that is not what is wrong."""
    name = _NAMES[package]
    make = f"Make an interpreter for it: {install(package)}; then --env.python {MADE}"
    match kind:
        case "missing":
            return f"{name} is not installed in {python}. {make}."
        case "namesake":
            return (
                f"the {package} of {python} ({facts['place']}) is another project of that name, "
                f"as the package index has it; {name} is got by git alone. {make}."
            )
        case "import":
            old = "protobuf" in facts["text"] or "Descriptors" in facts["text"]
            why = " The game's protocol needs protobuf 3.20." if old else ""
            return f"{python} cannot import {name}: {facts['text']}.{why} {make}."
        case "no game":
            if facts["told"]:
                where = f"SC2PATH is {facts['base']!r}, which has no folder Versions of the game"
            else:
                where = f"SC2PATH is not set, and there is no game in {facts['base']}"
            return f"{where}. Get {GAME}."
        case "game":
            return f"the game in {facts['base']} cannot be used: {facts['text']}. Get {GAME}."
    return ""


def refusal(task: str, python: str, kind: str, facts: Mapping[str, Any]) -> str:
    """Why a task cannot be made, and what to do.

    Args:
        task: its id.
        python: the interpreter that was asked.
        kind: of `race.envs.starcraft.game.RefusedError`.
        facts: of it.
    """
    package = task.partition("/")[0]
    facts = _open_ended(facts)
    told = missing(package, python, kind, facts)
    if told:
        return f"Task {task}: {told}"
    match kind:
        case "unknown":
            known = [f"{package}/{name}" for name in facts["known"]]
            near = ", ".join(difflib.get_close_matches(task, known, 3, 0.0))
            form = " Scenarios are named RACE_N_vs_M." if package == "smacv2" else ""
            return f"There is no task {task!r}. The nearest are {near}.{form}"
        case "map file":
            return (
                f"Task {task}: the map {facts['path']} is not there. Copy the folder SMAC_Maps of "
                f"{SOURCES[package]} (or its SMAC_Maps.zip) into the game's folder Maps."
            )
        case "arguments":
            return (
                f"Task {task}: {_NAMES[package]}'s environment cannot be made: {facts['text']}. "
                "--env.kwargs are its arguments."
            )
    return f"Task {task}: {failure(kind, facts)}"


def failure(kind: str, facts: Mapping[str, Any]) -> str:
    """What went wrong in a game."""
    text = _open_ended(facts).get("text") or "it gave no reason"
    if kind == "died":
        return f"it ended or did not answer ({text})."
    return f"{text}."


def _open_ended(facts: Mapping[str, Any]) -> Mapping[str, Any]:
    """With what others said without its full stop, since a message goes on after it."""
    return {**facts, "text": facts["text"].rstrip(".")} if facts.get("text") else facts
