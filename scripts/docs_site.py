"""What the site of the documents has besides `docs/`: pages made of the code, and of files above.

A hook of MkDocs (`mkdocs.yml`); `make docs` builds the site.
"""

import dataclasses
import os
import re
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

ROOT = Path(__file__).parent.parent

ABOVE = {
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "results/README.md": "archives.md",
    "LICENSE": "LICENSE.txt",
}
"""Files outside ``docs``, and their places on the site."""

MODULES = (
    ("race.envs", ("make_task", "task_ids", "describe_tasks", "TaskInfo", "factorised")),
    ("race.envs.pettingzoo", ("parallel_task",)),
    ("race.envs.jaxmarl", ("jaxmarl_task",)),
    ("race.envs.pymarl", ("pymarl_task",)),
    ("race.envs.micro", None),
    ("race.types", None),
    ("race.learners.base", None),
    ("race.errors", None),
)
"""Modules that users import from, and which of their names; None: all that are public."""


def settings_page() -> str:
    """Every setting of a run, out of the dataclasses themselves."""
    from race.cli.train import Train
    from race.config.settings import Config

    lines = [
        "# Settings",
        "",
        "Every option of `race train`, which is also a keyword of `race.train` and a name in a "
        "settings file; groups are dictionaries there, and tables ([from Python](python.md), "
        "[files](python.md#settings-from-a-file)). `race train TASK --help` shows those that a "
        "task has a use for. In square brackets: the default.",
        "",
        "## A run",
        "",
        *_table(Train, ""),
    ]
    derived = {field.name for field in dataclasses.fields(Config)} - {
        field.name for field in dataclasses.fields(Train)
    }
    lines += ["", "In `config.json` alone, worked out from the task:", ""]
    lines += [f"- `{name}`" for name in sorted(derived)]
    for field in dataclasses.fields(Train):
        if dataclasses.is_dataclass(field.type):
            about = " ".join((field.type.__doc__ or "").split("\n\n")[0].split())
            lines += ["", f"## {field.name}", "", _prose(about), ""]
            lines += _table(field.type, f"{field.name}.")
    return "\n".join([*lines, "", *_presets(), ""])


def _table(group: Any, prefix: str) -> Iterator[str]:
    from race.cli.help import options_of

    yield from ("| option | what it is |", "|---|---|")
    for option in options_of(group, prefix):
        yield f"| `{option.flag}` | {_prose(option.text)} |"


def _prose(text: str) -> str:
    """Text for a cell of a table, in which only code is markup."""
    parts = text.split("`")
    parts[::2] = [re.sub(r"([\\*_|<>\[\]])", r"\\\1", part) for part in parts[::2]]
    return "`".join(parts).replace("\n", " ")


def _presets() -> Iterator[str]:
    from race.config.presets import PRESETS

    yield from ("## Presets", "", "`--preset` sets of `learner`:", "")
    names = list(PRESETS)
    yield f"| setting | {' | '.join(names)} |"
    yield "|---" * (len(names) + 1) + "|"
    for field in dataclasses.fields(PRESETS["paper"]):
        values = [getattr(preset, field.name) for preset in PRESETS.values()]
        if any(value != values[0] for value in values):
            yield f"| `{field.name}` | {' | '.join(map(str, values))} |"


def reference_pages() -> Iterator[tuple[str, str]]:
    """(place, content) of a page for `race`, and for each module that users import from."""
    import race

    lines = ["# race", "", "What `import race` gives.", ""]
    stub = (ROOT / "race/__init__.pyi").read_text()
    for module, name in sorted(re.findall(r"^from (\S+) import (\w+) as \2$", stub, re.M)):
        heading = ("show_root_heading: true", f"heading: race.{name}", f"toc_label: {name}")
        lines += _directive(f"{module}.{name}", *heading)
    lines += ["## Constants", ""]
    for name in re.findall(r"^(\w+): ", stub, re.M):
        lines.append(f"- `race.{name}`: {getattr(race, name)} in this version")
    yield "reference/race.md", "\n".join([*lines, ""])
    for module, names in MODULES:
        options = ["show_root_heading: false", "show_root_toc_entry: false"]
        if names is not None:
            options.append(f"members: [{', '.join(names)}]")
        text = "\n".join([f"# {module}", "", *_directive(module, *options)])
        yield f"reference/{module}.md", text


def _directive(name: str, *options: str) -> list[str]:
    each = (f"      {option}" for option in (*options, "heading_level: 2"))
    return [f"::: {name}", "    options:", *each, ""]


def moved(text: str, source: str, place: str) -> str:
    """A page with its links as they have to be on the site.

    Args:
        text: the page.
        source: its place in the checkout, such as ``docs/runs.md``.
        place: its place on the site, such as ``runs.md``.
    """
    folder = (ROOT / source).parent

    def replaced(match: re.Match[str]) -> str:
        before, target, after = match.groups()
        if "://" in target or not target:
            return match[0]
        path = Path(os.path.normpath(folder / target)).relative_to(ROOT).as_posix()
        on_site = ABOVE.get(path, path.removeprefix("docs/"))
        parent = PurePosixPath(place).parent.as_posix()
        return f"{before}{os.path.relpath(on_site, parent)}{after}"

    return re.sub(r"(\]\()([^)#\s]*)([^)]*\))", replaced, text)


def on_files(files: Any, config: Any) -> Any:
    """Adds the pages that are not in ``docs``."""
    from mkdocs.structure.files import File

    made = {"settings.md": settings_page(), **dict(reference_pages())}
    for source, place in ABOVE.items():
        text = (ROOT / source).read_text()
        made[place] = moved(text, source, place) if place.endswith(".md") else text
    for place, text in made.items():
        files.append(File.generated(config, place, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Links out of ``docs`` lead to where those files are on the site."""
    if page.file.generated_by is not None:
        return markdown
    place = page.file.src_uri
    return moved(markdown, f"docs/{place}", place)
