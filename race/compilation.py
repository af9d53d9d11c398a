"""The persistent compilation cache: programs compiled once serve later processes."""

import os
from pathlib import Path

import jax


def cache_directory() -> Path:
    """``$XDG_CACHE_HOME/race/jax``, by default ``~/.cache/race/jax``."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "race" / "jax"


def use_cache() -> None:
    """Turns the cache on, unless JAX was given one already or the folder cannot be written."""
    if jax.config.jax_compilation_cache_dir is not None:  # type: ignore[attr-defined]
        return
    directory = cache_directory()
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    jax.config.update("jax_compilation_cache_dir", str(directory))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
