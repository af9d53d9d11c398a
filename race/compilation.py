"""The persistent compilation cache: programs compiled once serve later processes."""

import os
from pathlib import Path

import jax

from race.errors import RaceError


def cache_directory() -> Path:
    """``$XDG_CACHE_HOME/race/jax``, by default ``~/.cache/race/jax``."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "race" / "jax"


def check_backend() -> None:
    """Looks whether JAX can compute at all.

    Raises:
        RaceError: if it cannot use what it was told to.
    """
    try:
        jax.devices()
    # It says so in several ways, an assertion among them.
    except Exception as error:
        asked = os.environ.get("JAX_PLATFORMS", "")
        told = " ".join(str(error).split())[:200] or "it does not say why"
        raise RaceError(
            f"JAX cannot compute here with JAX_PLATFORMS={asked!r} ({told}). Unset it, or set it "
            "to cpu, to compute on the processor; `race doctor` shows what is here."
        ) from error


def use_cache() -> None:
    """Turns the cache on, unless JAX was given one already or the folder cannot be written.

    Raises:
        RaceError: if JAX cannot compute here.
    """
    check_backend()
    if jax.config.jax_compilation_cache_dir is not None:  # type: ignore[attr-defined]
        return
    directory = cache_directory()
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    jax.config.update("jax_compilation_cache_dir", str(directory))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
