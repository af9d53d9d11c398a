"""Numbers that 32 bits do not hold are refused by name."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from race.config.hyper import hyper_of
from race.config.presets import resolve
from race.config.settings import Config
from race.errors import ConfigError

GROUPS = ("learner", "facmac", "race", "evaluation", "checkpoint")
PLAIN = resolve(Config("some-task"))
NUMBERS = [
    (group, field.name)
    for group in GROUPS
    for field in dataclasses.fields(getattr(PLAIN, group))
    if type(getattr(getattr(PLAIN, group), field.name)) in (int, float)
]


def with_number(group: str, name: str, value: Any) -> Config:
    return dataclasses.replace(
        PLAIN, **{group: dataclasses.replace(getattr(PLAIN, group), **{name: value})}
    )


@pytest.mark.parametrize(("group", "name"), NUMBERS)
def test_no_number_beyond_32_bits_passes(group: str, name: str) -> None:
    kind = type(getattr(getattr(PLAIN, group), name))
    too_large = [10**20, -(10**20), 2**31] if kind is int else [1e300, 1e39, 1e-300]
    if name in ("exploration_noise", "smoothing_noise"):
        too_large.append(1e5)
    for value in too_large:
        option = f"{group}.{name.replace('_', '-')}"
        with pytest.raises(ConfigError, match=rf"{option}( is|.* {value})"):
            resolve(with_number(group, name, value))


@pytest.mark.parametrize("group", ["learner", "facmac"])
def test_a_discount_that_rounds_to_one_is_refused(group: str) -> None:
    with pytest.raises(ConfigError, match=f"--{group}.discount is 0.9999999999"):
        resolve(with_number(group, "discount", 0.9999999999))
    resolve(with_number(group, "discount", 0.9999))


@settings(max_examples=200, deadline=None)
@given(st.sampled_from(NUMBERS), st.one_of(st.integers(), st.floats()))
def test_whatever_passes_is_a_finite_number_of_the_programs(
    place: tuple[str, str], value: Any
) -> None:
    group, name = place
    kind = type(getattr(getattr(PLAIN, group), name))
    if kind is not type(value):
        return
    try:
        config = resolve(with_number(group, name, value))
    except ConfigError as error:
        told = str(error)
        assert f"{group}.{name.replace('_', '-')}" in told
        return
    numbers = np.array(hyper_of(config), np.float64)
    assert not np.isinf(numbers).any()
    if kind is float:
        assert (np.float32(value) == 0) == (value == 0)
