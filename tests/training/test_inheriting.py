"""Runs that begin with the teams of another: of every method that one can come from."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from race.algorithms import algorithm_of
from race.algorithms.inheriting import begun_with, parts
from race.config.hyper import hyper_of
from race.config.presets import resolve
from race.config.settings import Config, FacmacConfig, RaceConfig
from race.config.shape import shape_of
from race.errors import ConfigError
from race.learners import learner_of
from race.training.inheriting import made_to_fit
from race.types import DiscreteSpec, EnvSpec

SPEC = DiscreteSpec("tiny", 3, 5, 6, 4, 5)
FACMAC = FacmacConfig(hidden_size=4, utility_sizes=(3, 3), mixer_size=2, hypernet_size=2)


def discrete(algo: str, seed: int = 1) -> Config:
    config = Config("tiny", algo=algo, facmac=FACMAC, race=RaceConfig(population_size=5), seed=seed)  # type: ignore[arg-type]
    return resolve(config, discrete=True)


def state_of(config: Config, spec: Any) -> Any:
    """A state as at the start, of random numbers, for which nothing is compiled."""
    algorithm, shape = algorithm_of(config), shape_of(config)
    rng = np.random.default_rng(config.seed)
    shapes = jax.eval_shape(
        lambda: algorithm.init(jax.random.key(0), spec, shape, hyper_of(config))
    )
    return jax.tree.map(
        lambda leaf: jnp.asarray(rng.normal(size=leaf.shape).astype(leaf.dtype)), shapes
    )


def teams_of(config: Config, state: Any, spec: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    groups = algorithm_of(config).tested(state, spec)
    encoders = {name: encoder for encoder, heads in groups for name in heads}
    return encoders, {name: head for _, heads in groups for name, head in heads.items()}


def same(one: Any, other: Any) -> None:
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)


PAIRS = [("race", "race"), ("race", "maddpg"), ("maddpg", "race"), ("race", "merl"), ("ea", "ea")]


@pytest.mark.parametrize(("source", "target"), PAIRS)
@pytest.mark.parametrize("kind", ["continuous", "discrete"])
def test_a_run_begins_with_the_other_s_teams(
    source: str,
    target: str,
    kind: str,
    tiny_spec: EnvSpec,
    tiny_config: Callable[..., Config],
) -> None:
    def configured(algo: str, seed: int) -> Config:
        if kind == "discrete":
            return discrete("facmac" if algo == "maddpg" else algo, seed)
        made = tiny_config("race" if algo in ("race", "merl", "ea") else algo, "maddpg")
        return dataclasses.replace(made, algo=algo, seed=seed)  # type: ignore[arg-type]

    spec: Any = tiny_spec if kind == "continuous" else SPEC
    origin, config = configured(source, 1), configured(target, 2)
    encoders, heads = teams_of(origin, state_of(origin, spec), spec)
    inherited = made_to_fit(encoders, heads, origin, Path("other"), config, spec)
    fresh = state_of(config, spec)
    state = begun_with(fresh, jax.tree.map(jnp.asarray, inherited))
    # The forms are those of the state, or programs would not take it.
    assert jax.tree.structure(state) == jax.tree.structure(fresh)
    assert [leaf.shape for leaf in jax.tree.leaves(state)] == [
        leaf.shape for leaf in jax.tree.leaves(fresh)
    ]
    encoders_now, heads_now = teams_of(config, state, spec)
    for name, other in (("marl", "champion"), ("champion", "marl")):
        if name in heads_now:
            there = name if name in heads else other
            np.testing.assert_array_equal(heads_now[name], heads[there])
            encoder = encoders[there]
            if config.whole_teams and name == "champion" and not origin.whole_teams:
                encoder = learner_of(shape_of(config)).of_each_agent(encoder)
            same(encoders_now[name], encoder)
    if config.has_marl:  # targets begin as copies
        target_now = (state.marl if target == "merl" else state).target
        same((target_now.encoder, target_now.head), tuple(inherited[:2]))
    # Other teams of the population are as they would have been.
    if config.has_population:
        for a, b in zip(
            *map(jax.tree.leaves, (state.population.teams, fresh.population.teams)), strict=True
        ):
            np.testing.assert_array_equal(a[1:], b[1:])
        same(parts(state).team, inherited.team)


@pytest.mark.parametrize(
    ("source", "change", "words"),
    [
        ("race", {"learner": {"hidden_sizes": (7, 4)}}, "encoder.hidden.bias"),
        ("race", {"learner": {"layer_norm": False}}, "normalises"),
        ("ea", {}, "heads of their own"),
    ],
)
def test_what_does_not_fit_is_told(
    source: str,
    change: dict[str, Any],
    words: str,
    tiny_spec: EnvSpec,
    tiny_config: Callable[..., Config],
) -> None:
    if source == "ea":
        origin, config, spec = discrete("ea"), discrete("facmac"), SPEC
    else:
        origin, config = tiny_config("race", "maddpg"), tiny_config("race", "maddpg", **change)
        spec = tiny_spec  # type: ignore[assignment]
    encoders, heads = teams_of(origin, state_of(origin, spec), spec)
    with pytest.raises(ConfigError, match=words) as told:
        made_to_fit(encoders, heads, origin, Path("other"), config, spec)
    assert "race show other" in str(told.value)
