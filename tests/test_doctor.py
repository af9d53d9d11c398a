"""What the doctor finds."""

import importlib.metadata
import sys
from pathlib import Path

import pytest

from race import doctor
from race.doctor import examine
from race.envs import starcraft
from race.envs.starcraft import Installed
from race.viewing.rendering import Renderer


def test_a_healthy_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "choose_renderer", lambda: Renderer("egl", "OpenGL through egl"))
    found = {finding.name: finding for finding in examine(tmp_path / "cache")}
    assert all(finding.status != "missing" for finding in found.values())
    needed = {"python", "jax", "gymnasium", "accelerator", "physics", "renderer", "video", "disk"}
    assert needed <= set(found)
    assert found["jax"].detail == importlib.metadata.version("jax")
    assert found["renderer"].status == "ok"


def test_what_is_missing_has_a_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "choose_renderer", lambda: Renderer("sketch", "no OpenGL"))
    real = importlib.metadata.version

    def version(name: str) -> str:
        if name == "optax":
            raise importlib.metadata.PackageNotFoundError(name)
        return real(name)

    monkeypatch.setattr(importlib.metadata, "version", version)
    (tmp_path / "file").write_text("in the way")
    found = {finding.name: finding for finding in examine(tmp_path / "file" / "cache")}
    assert found["optax"].status == "missing"
    assert found["optax"].remedy.startswith("pip install 'optax")
    assert found["renderer"].status == "warning"
    assert "apt-get install" in found["renderer"].remedy
    assert found["compilation cache"].status == "missing"


def test_starcraft_is_one_line_for_those_who_do_not_want_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    absent = Installed(sys.executable, {}, "SMAC is not installed", there=False)
    monkeypatch.setattr(starcraft, "look", lambda package, python: absent)
    monkeypatch.delenv("SC2PATH", raising=False)
    finding = doctor._starcraft(None)
    assert (finding.status, finding.remedy) == ("ok", "")
    assert "race doctor --python" in finding.detail
    monkeypatch.setenv("SC2PATH", "/games")
    wanted = [doctor._starcraft(None)]
    monkeypatch.delenv("SC2PATH")
    wanted.append(doctor._starcraft(sys.executable))
    for finding in wanted:
        assert finding.status == "warning"
        assert "pip install 'pysc2==4.0.0'" in finding.remedy
