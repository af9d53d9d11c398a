"""What a release says about itself, in every place that says it."""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from pathlib import Path
from typing import Any

import pytest
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


@pytest.mark.parametrize("borrows", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_the_wheel_trains_in_an_empty_environment_far_from_the_checkout(
    tmp_path: Path, borrows: bool
) -> None:
    """Built from a copy of what is under version control, and installed with what it asks for.

    Or, since that takes minutes, with this environment's libraries.
    """
    env = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "XLA_FLAGS")}

    def call(*words: str | Path, folder: Path = tmp_path) -> str:
        done = subprocess.run(words, cwd=folder, env=env, capture_output=True, text=True)
        assert done.returncode == 0, f"{words}\n{done.stdout}\n{done.stderr}"
        return done.stdout

    source, wheels, away = (tmp_path / name for name in ("source", "wheels", "away"))
    for name in call("git", "ls-files", folder=ROOT).splitlines():
        if (ROOT / name).exists():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, source / name)
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet")
    call(*pip, "wheel", "--no-deps", "--wheel-dir", wheels, source)
    (wheel,) = wheels.glob("*.whl")
    with zipfile.ZipFile(wheel) as content:
        packed = set(content.namelist())
    for name in call("git", "ls-files", "race", folder=ROOT).splitlines():
        assert name in packed or not (ROOT / name).exists(), f"{name} is not in the wheel"
    assert not [name for name in packed if name.startswith(("tests/", "docs/", "scripts/"))]

    venv.create(tmp_path / "empty")
    python = tmp_path / "empty/bin/python"
    if borrows:
        (place,) = (tmp_path / "empty/lib").glob("python*/site-packages")
        # Paths in such a file are searched, but what lies there is not: no editable installation.
        (place / "borrowed.pth").write_text(sysconfig.get_path("purelib"))
    call(*pip, "--python", python, "install", *(["--no-deps"] if borrows else []), wheel)
    away.mkdir()
    where = call(python, "-c", "import race; print(race.__file__)", folder=away)
    assert where.startswith(str(tmp_path / "empty"))
    script = tmp_path / "empty/bin/race"
    little = "--algo matd3 --env-steps 60 --learner.random-steps 20 --learner.hidden-sizes 10 8"
    call(script, "train", "probe/target", *little.split(), "--run-dir", "run", folder=away)
    assert (away / "run/DONE").exists()
    if borrows:
        return
    assert "episodes" in call(script, "evaluate", "run", "--episodes", "2", folder=away)
    assert "micro/MMM2" in call(script, "list", folder=away)
