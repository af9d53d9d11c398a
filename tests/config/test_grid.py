"""Combinations of settings: all of them, or some drawn."""

from typing import Any

import numpy as np
import pytest

from race.config.grid import MOST_RUNS, points, read_grid, with_seed
from race.config.presets import PRESETS
from race.config.settings import Config
from race.errors import ConfigError

SMALL = {"task": "probe/target", "seeds": "1-3"}


def test_every_combination_is_there_once() -> None:
    grid = read_grid(
        SMALL
        | {
            "algo": ["race", "matd3"],
            "env_steps": 1000,
            "learner": {"actor_learning_rate": [1e-3, 3e-4], "hidden_sizes": [12, 8]},
            "race": {"mutation_draw": ["row", "weight"]},
        }
    )
    found = points(grid)
    assert grid.seeds == (1, 2, 3)
    keys = {
        (p.asked.algo, p.asked.learner.actor_learning_rate, p.asked.race.mutation_draw)
        for p in found
    }
    assert len(found) == len(keys) == 8
    for point in found:
        # What is one value is no alternative, also where it is a list itself.
        assert point.asked.learner.hidden_sizes == (12, 8)
        assert point.asked.env_steps == 1000
        assert set(point.varied) == {"algo", "learner.actor_learning_rate", "race.mutation_draw"}
    assert with_seed(found[0].asked, 7).seed == 7


def test_lists_of_lists_are_alternatives_of_lists() -> None:
    found = points(read_grid(SMALL | {"learner": {"hidden_sizes": [[12, 8], [4, 3]]}}))
    assert [p.asked.learner.hidden_sizes for p in found] == [(12, 8), (4, 3)]


def test_presets_and_ablations_are_axes_too() -> None:
    grid = read_grid(
        SMALL
        | {
            "preset": ["paper", "demo"],
            "ablation": ["", ["no-mutation", "no-injection"], "vfm-only"],
        }
    )
    found = points(grid)
    assert [p.ablation for p in found[:3]] == [(), ("no-mutation", "no-injection"), ("vfm-only",)]
    assert found[-1].asked.learner == PRESETS["demo"]
    assert found[0].asked.learner == PRESETS["paper"]
    assert points(read_grid(SMALL))[0].asked == Config("probe/target")


def test_draws_are_the_same_for_the_same_seed_and_never_twice_the_same() -> None:
    axes = {"learner": {"batch_size": [8, 16, 32], "policy_delay": [1, 2]}}

    def drawn(seed: int) -> list[dict[str, Any]]:
        sweep = {"sweep": {"draws": 4, "seed": seed}}
        return [point.varied for point in points(read_grid(SMALL | axes | sweep))]

    assert drawn(1) == drawn(1) != drawn(2)
    assert len({repr(varied) for varied in drawn(1)}) == 4
    every = points(read_grid(SMALL | axes | {"sweep": {"draws": 6}}))
    assert len({repr(point.varied) for point in every}) == 6


def test_ranges_are_drawn_from_evenly() -> None:
    ranges = {
        "learner": {
            "actor_learning_rate": {"from": 1e-4, "to": 1e-2, "scale": "log"},
            "discount": {"from": 0.9, "to": 1.0},
            "batch_size": {"from": 3, "to": 5},
        }
    }
    found = [p.asked.learner for p in points(read_grid(SMALL | ranges | {"sweep": {"draws": 900}}))]
    rates = np.log10([learner.actor_learning_rate for learner in found])
    assert rates.min() >= -4
    assert rates.max() <= -2
    assert abs((rates < -3).mean() - 0.5) < 0.07
    discounts = np.array([learner.discount for learner in found])
    assert 0.9 <= discounts.min() < 0.91 < 0.99 < discounts.max() <= 1.0
    counts = np.bincount([learner.batch_size for learner in found])
    assert set(np.flatnonzero(counts)) == {3, 4, 5}
    assert counts[3:].min() > 240


@pytest.mark.parametrize(
    ("description", "told"),
    [
        ({}, "names no task"),
        ({"task": 3}, "task is 3"),
        ({"task": []}, "task is"),
        ({"algoo": "race"}, "no setting algoo. Did you mean algo"),
        ({"learner": {"actor-learning-rate": 1e-3}}, "Did you mean actor_learning_rate"),
        ({"learner": 3}, r"must be a table: \[learner\]"),
        ({"algo": ["race", "rice"]}, "'rice' among its values"),
        ({"env_steps": 1.5}, "env_steps is 1.5"),
        ({"env_steps": [5, 5]}, "twice"),
        ({"seeds": [1, 1]}, "seeds is"),
        ({"seeds": "2-1"}, "--seeds is '2-1'"),
        ({"seeds": []}, "seeds is"),
        ({"preset": "no"}, "no preset 'no'"),
        ({"ablation": 3}, "names are texts"),
        ({"ablation": ["no-brain"]}, "no ablation 'no-brain'; there are vfm-only"),
        ({"sweep": {"draws": 0}}, "sweep.draws is 0"),
        ({"sweep": {"draws": 3}}, "there are 1 combinations"),
        ({"sweep": {"seed": "x"}}, "sweep.seed is 'x'"),
        ({"learner": {"discount": {"from": 0.1, "to": 0.9}}}, "how many to draw"),
        ({"learner": {"discount": {"from": 0.9, "to": 0.1}}}, "a range is written as"),
        ({"learner": {"discount": {"from": 0.1}}}, "a range is written as"),
        ({"algo": {"from": 1, "to": 2}}, "is no number"),
        (
            {"learner": {"discount": {"from": 0, "to": 1, "scale": "log"}}, "sweep": {"draws": 2}},
            "begins above 0",
        ),
        ({"learner": {"batch_size": list(range(1, MOST_RUNS + 2))}}, "Draw some of them"),
    ],
)
def test_what_is_not_understood(description: dict[str, Any], told: str) -> None:
    task = {} if description == {} else {"task": "probe/target"}
    with pytest.raises(ConfigError, match=told):
        points(read_grid(task | description))
