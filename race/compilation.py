"""How this process compiles and computes: the cache of programs, precision, determinism."""

import os
from pathlib import Path

import jax

from race.config.compute import ComputeConfig
from race.errors import RaceError

PRECISION = {"full": "highest", "tf32": "tensorfloat32"}
DETERMINISTIC = "--xla_gpu_deterministic_ops=true"


def cache_directory() -> Path:
    """``$XDG_CACHE_HOME/race/jax``, by default ``~/.cache/race/jax``."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "race" / "jax"


def cores() -> list[int]:
    """The processor's cores that this process may run on; none where the system does not say."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


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


def use_cache(compute: ComputeConfig | None = None) -> None:
    """Lets this process compute as a run asks for, and turns the cache of programs on.

    The cache stays as it is if JAX was given one already, or the folder cannot be written. XLA
    reads its flags when it first looks for devices: call this before anything is computed. What
    ``XLA_FLAGS`` says already is kept.

    Args:
        compute: how an accelerator computes; None: as by default.

    Raises:
        RaceError: if JAX cannot compute here.
    """
    compute = compute or ComputeConfig()
    flags = os.environ.get("XLA_FLAGS", "")
    if compute.deterministic and DETERMINISTIC not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {DETERMINISTIC}".strip()
    check_backend()
    if jax.default_backend() != "cpu":  # where JAX itself would take tf32 for float32
        jax.config.update("jax_default_matmul_precision", PRECISION[compute.matmul])
    if jax.config.jax_compilation_cache_dir is not None:  # type: ignore[attr-defined]
        return
    directory = cache_directory()
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    jax.config.update("jax_compilation_cache_dir", str(directory))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
