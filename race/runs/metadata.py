"""Where a run came from: versions, commit, machine, command."""

import contextlib
import importlib.metadata
import os
import platform
import re
import subprocess
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jax

from race import ALGORITHM_VERSION, __version__

DISTRIBUTION = "race-marl"

_REQUIREMENT = re.compile(r"([\w.-]+)\s*(?:\[([^\]]*)\])?")
_EXTRA = re.compile(r"extra\s*==\s*['\"]([^'\"]+)")


def metadata(environment: Mapping[str, Any]) -> dict[str, Any]:
    """What one needs to know to repeat a run that starts now, as plain JSON values.

    Versions of race, of its algorithm (`race.ALGORITHM_VERSION`) and of every installed
    distribution it needs, directly or not; Python, system and processor; git commit of the source,
    if it is a checkout; devices; start time; command line; and ``environment`` as it is.
    """
    return {
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": sys.argv,
        "environment": dict(environment),
        "race": __version__,
        "algorithm_version": ALGORITHM_VERSION,
        "versions": _versions(),
        "git": _git(Path(__file__).resolve().parent.parent),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "processor": _processor(),
        "processors": os.cpu_count(),
        "backend": jax.default_backend(),
        "devices": [device.device_kind for device in jax.devices()],
    }


def _versions() -> dict[str, str]:
    found: dict[str, str] = {}
    seen: set[tuple[str, frozenset[str]]] = set()
    todo = [(DISTRIBUTION, frozenset({"cuda"}))]
    while todo:
        name, extras = todo.pop()
        if (name, extras) in seen:
            continue
        seen.add((name, extras))
        try:
            distribution = importlib.metadata.distribution(name)
        except importlib.metadata.PackageNotFoundError:
            continue
        found[name] = distribution.version
        for line in distribution.requires or []:
            requirement = _REQUIREMENT.match(line)
            only_for = set(_EXTRA.findall(line))
            if requirement and (not only_for or only_for & extras):
                wanted = frozenset((requirement[2] or "").replace(" ", "").split(",")) - {""}
                todo.append((requirement[1].lower().replace("_", "-"), wanted))
    return dict(sorted(found.items()))


def _git(source: Path) -> dict[str, Any] | None:
    """Commit of the checkout that ``source`` belongs to; ``modified`` counts untracked files."""
    # An installed package may lie in the checkout of another project, which does not track it.
    if _output(source, "ls-files", "--error-unmatch", "__init__.py") is None:
        return None
    commit = _output(source, "rev-parse", "HEAD")
    status = _output(source, "status", "--porcelain", "--", ".")
    return None if commit is None else {"commit": commit, "modified": status != ""}


def _output(folder: Path, *arguments: str) -> str | None:
    command = ["git", "--no-optional-locks", "-C", str(folder), *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError, UnicodeDecodeError):
        return None
    return done.stdout.strip()


def _processor() -> str:
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(errors="replace").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor()
