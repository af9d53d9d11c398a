"""How a process compiles and computes."""

import dataclasses
import os
from collections.abc import Iterator
from typing import Any

import jax
import pytest

from race.compilation import DETERMINISTIC, use_cache
from race.config.compute import ComputeConfig
from race.config.presets import resolve
from race.config.saved import from_json, to_json
from race.config.settings import Config
from race.training.cohort import kind_of


@pytest.fixture
def precision() -> Iterator[None]:
    name = "jax_default_matmul_precision"
    before = getattr(jax.config, name)
    yield
    jax.config.update(name, before)


def test_a_processor_computes_as_it_always_does(precision: None) -> None:
    before = jax.config.jax_default_matmul_precision
    use_cache(ComputeConfig(matmul="tf32"))
    assert jax.config.jax_default_matmul_precision == before


@pytest.mark.parametrize(("matmul", "told"), [("full", "highest"), ("tf32", "tensorfloat32")])
def test_an_accelerator_multiplies_as_asked(
    matmul: Any, told: str, precision: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    use_cache(ComputeConfig(matmul=matmul))
    assert jax.config.jax_default_matmul_precision == told


def test_determinism_is_asked_for_once_beside_what_is_asked_for_already(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("XLA_FLAGS", "--xla_some_flag=1")
    use_cache()
    assert os.environ["XLA_FLAGS"] == "--xla_some_flag=1"
    for _ in range(2):
        use_cache(ComputeConfig(deterministic=True))
        assert os.environ["XLA_FLAGS"] == f"--xla_some_flag=1 {DETERMINISTIC}"


def test_runs_that_compute_differently_share_no_cohort_and_older_ones_say_nothing_of_it() -> None:
    config = resolve(Config("probe/target"))
    other = dataclasses.replace(config, compute=ComputeConfig(matmul="tf32"))
    assert kind_of(config) != kind_of(other)
    assert from_json(to_json(other)) == other
    older = to_json(config)
    del older["compute"]
    assert from_json(older) == config
