"""Writes what commands print into the documents that show it, so that no number is copied by hand.

A document marks such a part with the command::

    <!-- race compare results/ARCHIVE.jsonl.gz --format markdown -->

    what it prints

    <!-- end of output -->

With ``first table of race compare ...`` it is the first table of that, under its title.

``python scripts/outputs.py`` brings all documents up to date; a test tells if one is not.
"""

import contextlib
import io
import os
import re
import shlex
from pathlib import Path
from typing import Final

from race.cli import main as race

ROOT: Final = Path(__file__).parent.parent
DOCUMENTS: Final = ("README.md", "docs/results.md", "docs/choices.md")
_FIRST: Final = "first table of "
_PART: Final = re.compile(
    rf"<!-- ({_FIRST})?race (.+?) -->\n(.*?)<!-- end of output -->", re.DOTALL
)


def renewed(text: str) -> str:
    """A document with what its commands print now; the current directory must be `ROOT`."""
    return _PART.sub(lambda part: _part(part.group(1) or "", part.group(2)), text)


def commands(text: str) -> list[str]:
    """The commands whose output a document shows."""
    return [part.group(2) for part in _PART.finditer(text)]


def _part(which: str, command: str) -> str:
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        race(shlex.split(command))
    text = printed.getvalue().strip()
    if which == _FIRST:
        title, table, *_ = text.split("\n\n")
        text = f"{title}\n\n{table}"
    # Some readers of Markdown want empty lines round tables.
    return f"<!-- {which}race {command} -->\n\n{text}\n\n<!-- end of output -->"


def main() -> None:
    """Brings the documents up to date."""
    os.chdir(ROOT)
    for name in DOCUMENTS:
        path = ROOT / name
        path.write_text(renewed(path.read_text()))


if __name__ == "__main__":
    main()
