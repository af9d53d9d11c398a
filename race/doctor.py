"""What is installed, what is missing, and the command that mends it."""

import importlib.metadata
import os
import platform
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from race import __version__
from race.compilation import check_backend, cores
from race.runs.metadata import DISTRIBUTION
from race.viewing.rendering import PACKAGES, choose_renderer

Status = Literal["ok", "warning", "missing"]


class Finding(NamedTuple):
    """One thing that was looked at."""

    name: str
    status: Status
    detail: str
    remedy: str = ""  # the command that mends it


def examine(cache: Path, python: str | None = None) -> Iterator[Finding]:
    """Looks at everything, one finding after the other. Raises nothing.

    Args:
        cache: folder of the compilation cache.
        python: the interpreter that has SMAC; None: this one.
    """
    yield Finding("race", "ok", f"{__version__}, in {Path(__file__).parent}")
    yield _python()
    yield from _packages()
    checks: list[tuple[str, Callable[[], Finding], str]] = [
        ("accelerator", _accelerator, "unset JAX_PLATFORMS"),
        ("physics", _physics, "pip install --force-reinstall 'gymnasium[mujoco]'"),
        ("renderer", _renderer, PACKAGES),
        ("video", _video, "pip install --force-reinstall imageio-ffmpeg"),
        ("machine", _machine, ""),
        ("compilation cache", lambda: _cache(cache), f"mkdir -p {cache}"),
        ("disk", _disk, ""),
        ("StarCraft II", lambda: _starcraft(python), "race doctor --python PATH"),
    ]
    for name, check, remedy in checks:
        try:
            yield check()
        except Exception as error:  # whatever is broken here is what was looked for
            yield Finding(name, "missing", f"{type(error).__name__}: {error}", remedy)


def _python() -> Finding:
    version = platform.python_version()
    good = (3, 11) <= sys.version_info < (3, 14)
    return Finding(
        "python",
        "ok" if good else "warning",
        version if good else f"{version}; race is made for 3.11 to 3.13",
        "" if good else "make PYTHON=/path/to/python3.11 demo",
    )


def _packages() -> Iterator[Finding]:
    try:
        required = importlib.metadata.requires(DISTRIBUTION) or []
    except importlib.metadata.PackageNotFoundError:
        yield Finding("packages", "missing", "race itself is not installed", "pip install .")
        return
    for requirement in required:
        if "extra ==" in requirement:
            continue
        name = re.split(r"[\[<>=!~; ]", requirement, maxsplit=1)[0]
        try:
            yield Finding(name, "ok", importlib.metadata.version(name))
        except importlib.metadata.PackageNotFoundError:
            needed = requirement.split(";")[0].strip()
            yield Finding(name, "missing", "not installed", f"pip install '{needed}'")


def _accelerator() -> Finding:
    import jax

    check_backend()
    devices = jax.devices()
    kinds = ", ".join(f"{d.platform} {d.device_kind}" for d in devices)
    if devices[0].platform == "cpu" and shutil.which("nvidia-smi"):
        return Finding(
            "accelerator",
            "warning",
            f"JAX uses {kinds}, though this machine has an NVIDIA driver",
            "pip install 'jax[cuda12]' (or 'jax[cuda13]', as the driver is)",
        )
    begin = time.perf_counter()
    for device in devices:
        square = jax.device_put(np.full((64, 64), 0.5, np.float32), device)
        if not np.allclose(jax.jit(lambda x: x @ x)(square), 16.0):
            return Finding("accelerator", "missing", f"{device} computes 64 x 64 products wrongly")
    told = f"a small program ran on each in {time.perf_counter() - begin:.1f} s"
    return Finding("accelerator", "ok", f"JAX {jax.__version__} on {kinds}; {told}")


def _physics() -> Finding:
    from race.config.settings import EnvConfig
    from race.envs import make_task

    task = make_task("mamujoco/Hopper-3x1", EnvConfig())
    env = task.make(None)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()
    return Finding("physics", "ok", "MuJoCo steps mamujoco/Hopper-3x1")


def _renderer() -> Finding:
    renderer = choose_renderer()
    if renderer.backend == "sketch":
        return Finding("renderer", "warning", renderer.reason, PACKAGES)
    return Finding("renderer", "ok", renderer.reason)


def _video() -> Finding:
    import imageio_ffmpeg

    return Finding("video", "ok", f"ffmpeg {imageio_ffmpeg.get_ffmpeg_version()}")


def _machine() -> Finding:
    count = len(cores()) or os.cpu_count()
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    status: Status = "ok" if memory >= 2 else "warning"
    return Finding("machine", status, f"{count} cores, {memory:.0f} GiB of memory")


def _starcraft(python: str | None) -> Finding:
    """Optional: smac/* and smacv2/* alone need it."""
    from race.envs import starcraft
    from race.envs.starcraft import telling

    looks = {package: starcraft.look(package, python) for package in telling.SOURCES}
    found = {package: look for package, look in looks.items() if look.there}
    if not found and python is None and "SC2PATH" not in os.environ:
        return Finding(
            "StarCraft II",
            "ok",
            "not set up; smac/* and smacv2/* alone need it (race doctor --python PYTHON tells how)",
        )
    if not found:
        where = looks["smac"].python
        return Finding(
            "StarCraft II",
            "warning",
            f"neither SMAC nor SMACv2 is in {where}: smac/* and smacv2/* need one of them",
            f"{telling.install('smac')} (or smacv2.git, or both); get {telling.GAME}; then "
            f"race doctor --python {telling.MADE} (docs/starcraft.md)",
        )
    told = [
        f"{package} {look.facts['code']}; game {look.facts['game']}; "
        + ", ".join(f"{name} {version}" for name, version in look.facts["libraries"].items())
        for package, look in found.items()
        if not look.wrong
    ]
    wrong = list(dict.fromkeys(look.wrong for look in found.values() if look.wrong))
    return Finding(
        "StarCraft II",
        "warning" if wrong else "ok",
        "; ".join(told) or "not set up",
        " ".join(wrong),
    )


def _cache(cache: Path) -> Finding:
    cache.mkdir(parents=True, exist_ok=True)
    probe = cache / f".probe-{os.getpid()}"
    probe.touch()
    probe.unlink()
    return Finding("compilation cache", "ok", str(cache))


def _disk() -> Finding:
    free = shutil.disk_usage(Path.cwd()).free / 2**30
    detail = f"{free:.1f} GiB free in {Path.cwd()}"
    return Finding("disk", "ok" if free >= 2 else "warning", detail)
