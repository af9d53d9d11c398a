"""Heads of the population that climb their value: who moves, how far, and what stays as it is."""

from collections.abc import Callable
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_race_update import B, separate

from race.algorithms import race
from race.algorithms.race_update import draw_teams
from race.config.hyper import hyper_of
from race.config.settings import Config
from race.config.shape import shape_of
from race.networks.optimization import descend_plainly
from race.types import EnvSpec

RATE = 0.25
KEYS = [jax.random.key(seed) for seed in range(24)]


class World:
    """A fresh state, and gradient steps on one minibatch."""

    def __init__(self, spec: EnvSpec, config: Config, batch: Any) -> None:
        self.spec, self.shape, self.hyper = spec, shape_of(config), hyper_of(config)
        self.batch = batch
        fresh = jax.jit(lambda key: race.init(key, spec, self.shape, self.hyper))
        self.state = separate(fresh(jax.random.key(11)))
        self._update = jax.jit(
            lambda state, step, key, hyper: race.update(
                state, batch, step, key, spec, self.shape, hyper
            )
        )

    def step(self, number: int, key: Any, **numbers: float) -> Any:
        hyper = self.hyper._replace(**{name: np.float32(x) for name, x in numbers.items()})
        return self._update(self.state, jnp.int32(number), key, hyper)

    def moved(self, after: Any) -> list[int]:
        """The places of teams whose heads are others now."""
        pairs = zip(np.asarray(after.heads), np.asarray(self.state.heads), strict=True)
        return [place for place, (new, old) in enumerate(pairs) if not np.array_equal(new, old)]


@pytest.fixture(scope="module")
def world_of(
    tiny_spec: EnvSpec, tiny_config: Callable[..., Config], batch_of: Callable[..., Any]
) -> Callable[..., World]:
    @cache
    def make(**choices: Any) -> World:
        config = tiny_config("race", "matd3", race={"head_learning_rate": RATE, **choices})
        return World(tiny_spec, config, batch_of(tiny_spec, B))

    return make


@pytest.fixture(scope="module")
def world(world_of: Callable[..., World]) -> World:
    return world_of(team_draw="once", marl_among_teams=False)


def assert_equal(one: Any, two: Any) -> None:
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    ("gradient", "expected"),
    [
        ([[3.0, 0.0], [0.0, 4.0]], [[1.0 - 0.3, 1.0], [1.0, 1.0 - 0.4]]),  # of norm 5: to 1
        ([[0.3, 0.0], [0.0, 0.4]], [[1.0 - 0.15, 1.0], [1.0, 1.0 - 0.2]]),
        ([[0.0, 0.0], [0.0, 0.0]], [[1.0, 1.0], [1.0, 1.0]]),
    ],
)
def test_a_plain_step_by_hand(gradient: Any, expected: Any) -> None:
    found = descend_plainly(jnp.ones((2, 2)), jnp.array(gradient), 0.5, 1.0)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_heads_wait_for_the_policy_delay(world: World) -> None:
    after, *_ = world.step(0, KEYS[0])
    assert_equal(after.population, world.state.population)
    after, *_ = world.step(1, KEYS[0])
    assert len(world.moved(after)) == 1


@pytest.mark.parametrize(
    ("team_draw", "marl_among_teams", "count"),
    [("once", False, 1), *(pytest.param("each", True, k, marks=pytest.mark.slow) for k in (1, 2))],
)
def test_the_team_of_equation_2_moves_and_no_other(
    world_of: Callable[..., World], team_draw: str, marl_among_teams: bool, count: int
) -> None:
    several = {} if count == 1 else {"teams_per_batch": count}
    world = world_of(team_draw=team_draw, marl_among_teams=marl_among_teams, **several)
    state, head = world.state, world.state.policies.head.params
    places, unlike = set(), 0
    for key in KEYS:
        first, second = draw_teams(state.heads, head, jax.random.split(key, 3)[0], world.shape)
        drawn = sorted(np.asarray(second.place).reshape(-1).tolist())
        after, *_ = world.step(1, key)
        # The MARL team, where it is drawn, learns by Eq. (7) alone.
        assert world.moved(after) == [place for place in drawn if place < len(state.heads)]
        places.update(drawn)
        unlike += sorted(np.asarray(first.place).reshape(-1).tolist()) != drawn
    assert places == set(range(5 + marl_among_teams))
    assert (unlike > 0) == (team_draw == "each")


def test_nothing_else_is_learned_otherwise(world: World, world_of: Callable[..., World]) -> None:
    learning, fixed = world, world_of(head_learning_rate=0.0)
    assert learning.shape != fixed.shape
    for key in KEYS[:3]:
        (one, *losses), (two, *same) = (world.step(1, key) for world in (learning, fixed))
        assert learning.moved(one) != fixed.moved(two) == []
        for name in ("policies", "critics", "target"):
            pairs = zip(
                *map(jax.tree.leaves, (getattr(one, name), getattr(two, name))), strict=True
            )
            for a, b in pairs:
                np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7)
        np.testing.assert_allclose(*map(jax.tree.leaves, (losses, same)), rtol=1e-5)


def test_a_step_is_as_long_as_rate_and_clip_say(world: World) -> None:
    def change(**numbers: float) -> Any:
        after, *_ = world.step(1, KEYS[0], **numbers)
        (place,) = world.moved(after)
        return np.asarray(after.heads[place], np.float64) - np.asarray(world.state.heads[place])

    whole = change()
    np.testing.assert_allclose(change(head_learning_rate=2 * RATE), 2 * whole, rtol=1e-3, atol=1e-6)
    # The weight of Eq. (2)'s second term is of what goes on into the encoders.
    np.testing.assert_allclose(change(vfm_team_weight=0.0), whole, rtol=1e-4, atol=1e-7)


def test_a_long_gradient_is_clipped(world: World) -> None:
    clip = 1e-2
    clipped, *_ = world.step(1, KEYS[0], gradient_clip=clip, critic_learning_rate=0.0)
    free, *_ = world.step(1, KEYS[0], critic_learning_rate=0.0)
    (place,) = world.moved(free)
    short, long = (
        np.asarray(after.heads[place], np.float64) - np.asarray(world.state.heads[place])
        for after in (clipped, free)
    )
    assert np.linalg.norm(long) > 2 * RATE * clip
    np.testing.assert_allclose(np.linalg.norm(short), RATE * clip, rtol=1e-3)
    np.testing.assert_allclose(
        short / np.linalg.norm(short), long / np.linalg.norm(long), atol=1e-3
    )


def test_padding_stays_zero_and_the_champion_what_it_was(world: World) -> None:
    state, champion = world.state, world.state.population.champion
    padded = ~np.broadcast_to(np.asarray(world.spec.action_mask)[:, None], champion.heads.shape)
    for key in KEYS[:6]:
        after, *_ = world.step(1, key)
        assert_equal(np.asarray(after.heads)[:, padded], np.asarray(state.heads)[:, padded])
        assert_equal(after.population.champion, champion)
        assert_equal(after.population.record, state.population.record)
