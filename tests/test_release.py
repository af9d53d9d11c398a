"""What a release says about itself, in every place that says it."""

import re
import tomllib
from pathlib import Path
from typing import Any

import yaml

import race

ROOT = Path(__file__).parent.parent


def read(name: str) -> Any:
    return yaml.safe_load((ROOT / name).read_text())


def test_the_version_is_the_same_everywhere() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    citation = read("CITATION.cff")
    assert race.__version__ == project["version"] == citation["version"]
    released = re.findall(r"^## (\S+) \((\S+)\)$", (ROOT / "CHANGELOG.md").read_text(), re.M)
    assert (citation["version"], citation["date-released"]) in released
    assert [version for version, _ in released] == sorted(
        (version for version, _ in released),
        key=lambda version: [int(number) for number in version.split(".")],
        reverse=True,
    )


def test_the_changelog_names_the_algorithm_of_every_version() -> None:
    _, *parts = re.split(r"^## ", (ROOT / "CHANGELOG.md").read_text(), flags=re.M)
    named = [int(re.findall(r"^Algorithm version (\d+)\.$", part, re.M)[0]) for part in parts]
    assert named[0] == race.ALGORITHM_VERSION
    assert named == sorted(named, reverse=True)


def test_citation_has_the_paper_of_the_readme() -> None:
    paper = read("CITATION.cff")["preferred-citation"]
    bibtex = re.sub(r"[{}]|\n\s+", " ", (ROOT / "README.md").read_text())
    assert " ".join(paper["title"].split()) in " ".join(bibtex.split()).replace(" :", ":")
    for author in paper["authors"]:
        assert f"{author['family-names']}, {author['given-names']}" in bibtex


def test_templates_ask_for_what_they_say() -> None:
    """Only elements and attributes that the forms have."""
    forms = [f for f in (ROOT / ".github/ISSUE_TEMPLATE").glob("*.yml") if f.stem != "config"]
    assert len(forms) == 3
    for form in forms:
        content = yaml.safe_load(form.read_text())
        assert {"name", "description", "body"} <= set(content), form.name
        ids = [element["id"] for element in content["body"]]
        assert len(set(ids)) == len(ids) > 0
        for element in content["body"]:
            assert element["type"] in ("textarea", "input")
            assert element["attributes"]["label"]


def test_nothing_is_published_that_was_not_checked_and_attested() -> None:
    jobs = read(".github/workflows/release.yml")["jobs"]

    def before(name: str) -> set[str]:
        needs = jobs[name].get("needs", [])
        names = {needs} if isinstance(needs, str) else set(needs)
        return names.union(*map(before, names)) if names else names

    assert before("publish") == {"build", "test", "check", "attest"}
    writers = {name for name in jobs if "id-token" in jobs[name].get("permissions", {})}
    assert writers == {"attest", "publish"}
    assert jobs["publish"]["environment"] == "release"
