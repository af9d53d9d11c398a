"""Settings of the test session, and the tiny task that most tests share.

`race` is imported inside the fixtures: this file is read before the type checks of
``--jaxtyping-packages`` are in place.
"""

import dataclasses
import mmap
import os
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache


def fast_compilation() -> str:
    """Tests compile many small programs and run each a few times: compile fast, run slowly.

    The older code generator of XLA takes a third of the newer one's time. A flag that a version of
    jaxlib does not know ends the process, so it is looked for first.
    """
    flags = "--xla_backend_optimization_level=0"
    wanted = b"xla_cpu_use_fusion_emitters"
    for library in Path(jaxlib.__file__).parent.glob("libjax_common*"):
        with (
            library.open("rb") as file,
            mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content,
        ):
            if content.find(wanted) >= 0:
                return f"{flags} --{wanted.decode()}=false"
    return flags


if "XLA_FLAGS" not in os.environ:
    os.environ["XLA_FLAGS"] = fast_compilation()
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


MOST_MAPPINGS = 25_000


@pytest.fixture(scope="session", autouse=True)
def cache_of_its_own(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Commands that tests run keep their compiled programs away from the user's cache."""
    os.environ["XDG_CACHE_HOME"] = str(tmp_path_factory.mktemp("cache"))


@pytest.fixture(autouse=True)
def cache_of_commands_alone() -> Iterator[None]:
    """Commands turn the cache of compiled programs on; later tests must not go on writing to it.

    Writing a large program of a process that holds many has been seen to crash jaxlib.
    """
    yield
    if jax.config.jax_compilation_cache_dir is not None:  # type: ignore[attr-defined]
        jax.config.update("jax_compilation_cache_dir", None)
        compilation_cache.reset_cache()


@pytest.fixture(autouse=True)
def few_programs() -> Iterator[None]:
    """Forgets compiled programs before their memory mappings are more than a process may have.

    Linux allows 65,530; a gradient step of RACE takes thousands, and jaxlib crashes at the limit.
    """
    yield
    mappings = Path("/proc/self/maps")
    if mappings.exists() and mappings.read_bytes().count(b"\n") > MOST_MAPPINGS:
        jax.clear_caches()


@pytest.fixture(scope="session")
def tiny_spec() -> Any:
    """Two agents of unequal sizes whose observations overlap and whose actions interleave."""
    from race.types import EnvSpec

    return EnvSpec(
        task="tiny",
        state_size=4,
        obs_index=((2, 0, 3), (1, 3)),
        action_index=((1,), (2, 0)),
        action_low=(-1.0,) * 3,
        action_high=(1.0,) * 3,
        episode_limit=5,
    )


@pytest.fixture(scope="session")
def tiny_config() -> Callable[..., Any]:
    """(algo, base, learner settings, race settings) -> a resolved Config of tiny networks.

    Targets are not smoothed and gradients not clipped, so that losses can be worked out; all
    teams enter the tournament, so that fates can be scripted.
    """
    from race.config.presets import resolve
    from race.config.settings import Config, FacmacConfig, LearnerConfig, RaceConfig

    def make(
        algo: str = "race",
        base: str = "matd3",
        learner: dict[str, Any] | None = None,
        race: dict[str, Any] | None = None,
    ) -> Any:
        learner_config = LearnerConfig(
            hidden_sizes=(5, 4), batch_size=3, smoothing_noise=0.0, gradient_clip=1e6
        )
        race_config = RaceConfig(
            policy_embedding_size=3,
            mine_size=6,
            vmm_weight=0.3,
            mutation_fraction=0.5,
            tournament_size=10,
        )
        if algo == "no-sharing":
            algo, race = "race", {**(race or {}), "sharing": False}
        return resolve(
            Config(
                task="tiny",
                algo=algo if algo in ("race", "merl", "ea") else base,  # type: ignore[arg-type]
                base=base,  # type: ignore[arg-type]
                learner=dataclasses.replace(learner_config, **(learner or {})),
                facmac=FacmacConfig(mixer_size=3, hypernet_size=4),
                race=dataclasses.replace(race_config, **(race or {})),
            )
        )

    return make


@pytest.fixture(scope="session")
def batch_of() -> Callable[..., Any]:
    """(spec, size, seed) -> a random minibatch; about a third of its samples terminated."""
    from race.types import Transition

    def make(spec: Any, size: int = 3, seed: int = 0) -> Any:
        rng = np.random.default_rng(seed)
        columns = (
            rng.normal(size=(size, spec.state_size)),
            rng.uniform(-1, 1, size=(size, spec.joint_action_size)),
            rng.normal(size=size),
            (np.arange(size) % 3 == 1).astype(float),
            rng.normal(size=(size, spec.state_size)),
        )
        return Transition(*(jnp.asarray(column, jnp.float32) for column in columns))

    return make


@pytest.fixture(scope="session")
def compiled() -> Callable[..., Callable[..., Any]]:
    """(algorithm, name, spec, config) -> that function of the algorithm, compiled once."""
    from evolving import evolving

    from race.config.hyper import hyper_of
    from race.config.shape import shape_of

    @cache
    def make(algorithm: Any, name: str, spec: Any, config: Any) -> Callable[..., Any]:
        shape, hyper = shape_of(config), hyper_of(config)
        function = evolving(algorithm) if name == "evolve" else getattr(algorithm, name)
        return jax.jit(partial(function, spec=spec, shape=shape, hyper=hyper))

    return make
