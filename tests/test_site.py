"""The documents and their site: links lead somewhere, no page and no setting is left out."""

import dataclasses
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any, get_type_hints

import pytest
import yaml
from loaded_scripts import loaded

import race
from race.config.settings import Config

ROOT = Path(__file__).parent.parent
DOCUMENTS = [
    *sorted(ROOT.glob("*.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
    ROOT / "results/README.md",
]


@pytest.fixture(scope="module")
def site() -> Any:
    """The hook that makes pages of the code."""
    return loaded("docs_site")


@pytest.fixture(scope="module")
def settings(site: Any) -> str:
    page: str = site.settings_page()
    return page


def prose(text: str) -> str:
    """A document without its blocks of code."""
    return re.sub(r"^ *```.*?^ *```", "", text, flags=re.DOTALL | re.MULTILINE)


def anchors(document: Path) -> set[str]:
    """Of the headings, as both MkDocs and repositories' pages make them."""
    headings = re.findall(r"^#+ (.*)$", prose(document.read_text()), re.MULTILINE)
    plain = (re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading) for heading in headings)
    return {re.sub(r"[^\w\s-]", "", text).strip().lower().replace(" ", "-") for text in plain}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(document: Path) -> None:
    text = prose(document.read_text())
    targets = re.findall(r"\]\(([^)\s]+)[^)]*\)", text) + re.findall(r' src="([^"]+)"', text)
    for target in targets:
        if "://" in target:
            continue
        place, _, anchor = target.partition("#")
        path = document.parent / place if place else document
        assert path.exists(), target
        if anchor:
            assert anchor in anchors(path), target


def test_a_wrong_anchor_would_be_seen(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# Rows of `metrics.jsonl`\n```sh\n# no heading\n```\n## C++\n")
    assert anchors(page) == {"rows-of-metricsjsonl", "c"}


def test_every_setting_is_on_the_page(settings: str) -> None:
    hints = get_type_hints(Config)
    assert len(hints) > 10
    for name, kind in hints.items():
        if not dataclasses.is_dataclass(kind):
            option = "TASK" if name == "task" else f"--{name.replace('_', '-')}"
            assert re.search(rf"`({option}\b[^`]*|{name})`", settings), name
            continue
        assert f"\n## {name}\n" in settings
        for field in dataclasses.fields(kind):  # type: ignore[arg-type]
            option = f"--{name}.{field.name.replace('_', '-')}"
            (text,) = re.findall(rf"^\| `{option}(?![\w-])[^`]*` \| (.*) \|$", settings, re.M)
            assert len(text) > 10, option


def test_defaults_and_presets_are_those_of_the_code(settings: str) -> None:
    assert re.search(r"^\| `--race.population-size INT` \| .*\\\[5\\\] \|$", settings, re.M)
    assert "| `hidden_sizes` | (400, 300) | (400, 300) | (160, 120) |" in settings


def test_every_public_name_has_its_place_in_the_reference(site: Any) -> None:
    pages = dict(site.reference_pages())
    stub = (ROOT / "race/__init__.pyi").read_text()
    names = re.findall(r"^from \S+ import (\w+) as \1$", stub, re.M)
    names += re.findall(r"^(\w+): ", stub, re.M)
    assert {"train", "Team", "ALGORITHM_VERSION"} < set(names) <= set(dir(race))
    for name in names:
        stated = (f"      heading: race.{name}\n", f"- `race.{name}`: ")
        assert any(text in pages["reference/race.md"] for text in stated), name
    for place in re.findall(r"^::: (\S+)$", pages["reference/race.md"], re.M):
        module, _, name = place.rpartition(".")
        source = (ROOT / f"{module.replace('.', '/')}.py").read_text()
        assert re.search(rf"^(def|class) {name}\b", source, re.M), place


def test_every_page_is_in_the_contents(site: Any) -> None:
    def places(nav: Any) -> set[str]:
        if isinstance(nav, str):
            return {nav}
        parts = nav.values() if isinstance(nav, dict) else nav
        return set().union(*map(places, parts))

    written = {
        path.relative_to(ROOT / "docs").as_posix()
        for path in DOCUMENTS
        if "docs" in str(path.relative_to(ROOT))
    }
    made = {"settings.md", *dict(site.reference_pages())}
    made |= {place for place in site.ABOVE.values() if place.endswith(".md")}
    assert not made & written
    contents = places(yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"])
    assert contents == written | made


def test_links_move_with_their_pages(site: Any) -> None:
    for text, source, place, expected in (
        ("[a](docs/runs.md#b)", "README.md", "index.md", "[a](runs.md#b)"),
        ("![a](docs/images/c.png)", "README.md", "index.md", "![a](images/c.png)"),
        ("[a](../results/README.md)", "docs/runs.md", "runs.md", "[a](archives.md)"),
        ("[a](../../CHANGELOG.md)", "docs/x/y.md", "x/y.md", "[a](../changelog.md)"),
        ("[a](../runs.md)", "docs/x/y.md", "x/y.md", "[a](../runs.md)"),
        ("[a](#b) [c](https://d.example/e)", "docs/runs.md", "runs.md", None),
    ):
        assert site.moved(text, source, place) == (expected or text)


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(site: Any, tmp_path: Path) -> None:
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    env = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(words, cwd=ROOT, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    for page in ("index", "settings", "reference/race", "gallery", "tutorials/engineer"):
        assert (tmp_path / f"{page}.html").exists()
    text = (tmp_path / "reference/race.html").read_text()
    assert 'id="race.api.commands.train"' in text
    for module, names in site.MODULES:
        text = (tmp_path / f"reference/{module}.html").read_text()
        assert all(f'id="{module}.{name}"' in text for name in names or ()), module
    assert (tmp_path / "images/2s3z.mp4").exists()
