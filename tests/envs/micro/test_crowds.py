"""How close units come in battles, and how many reach a target that they surround."""

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import NDArray
from reels import MANNERS, Reel, reel
from test_opponent import watch

from race.envs.micro import make, map_names, tournament
from race.envs.micro.maps import parse_map
from race.envs.micro.policies import POLICIES
from race.envs.micro.scenario import APART, build
from race.envs.micro.state import start


def contacts(name: str, r: Reel) -> NDArray[np.float64]:
    """Distances of pairs on the ground, of their contact distance; nan where one is dead."""
    contact = np.asarray(make(name).scenario.contact, float)
    one, other = np.nonzero(np.triu(contact > APART, 1))
    shots = r.shots
    distance = np.hypot(shots.x[:, one] - shots.x[:, other], shots.y[:, one] - shots.y[:, other])
    both = (shots.health[:, one] > 0) & (shots.health[:, other] > 0)
    return np.where(both, distance / contact[one, other], np.nan)


def backwards(r: Reel) -> tuple[int, int]:
    """Loops in which units go back where they came from, and all in which they go on.

    Agents that are told to turn back do not count.
    """
    dx, dy = np.diff(r.shots.x, axis=0), np.diff(r.shots.y, axis=0)
    way, lives = np.hypot(dx, dy), r.shots.health[2:] > 0
    goes = (way[1:] > 0.01) & (way[:-1] > 0.01) & lives
    told = np.arange(1, len(dx)) % 8 == 0
    back = goes & (dx[1:] * dx[:-1] + dy[1:] * dy[:-1] < 0)
    back[told, : r.n] = False
    return int(back.sum()), int(goes.sum())


CROWDED = {"2c_vs_64zg", "MMM2", "corridor", "bane_vs_bane"}
"""Many small units, large ones, walls, bursts; the other maps are slow tests."""


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=[] if n in CROWDED else pytest.mark.slow) for n in map_names()],
)
def test_units_keep_apart_and_do_not_tremble(name: str) -> None:
    """Of pairs nearer than 1.2 of contact under 1% are nearer than 0.9, none than 0.5."""
    near = close = back = goes = 0
    for manner in sorted(MANNERS):
        r = reel(name, 0, manner)
        share = contacts(name, r)
        near, close = near + int((share < 1.2).sum()), close + int((share < 0.9).sum())
        assert share.size == 0 or np.nanmin(share, initial=1.0) > 0.5
        turned, went = backwards(r)
        back, goes = back + turned, goes + went
    assert close <= 0.01 * max(near, 100)
    assert back <= 0.03 * max(goes, 100)


RING = math.floor(math.pi / math.asin(0.375 / 1.475))
"""Zerglings, 0.75 apart, whose centres find room 1.475 from the Colossus's: 0.1 + 1.0 + 0.375."""


@functools.cache
def siege(zerglings: int) -> Any:
    text = 'description = "t"\nepisode_limit = 400\n[enemy_order]\nkind = "attack_nearest"\n'
    text += '[[allies]]\nunit = "Colossus"\ncount = 1\nat = [10.0, 16.0]\n'
    text += f'[[enemies]]\nunit = "Zergling"\ncount = {zerglings}\nat = [18.0, 16.0]\n'
    scenario = build(parse_map("siege", text))
    scenario = dataclasses.replace(scenario, damage=jnp.zeros_like(scenario.damage))
    return watch(scenario, start(scenario).units, 30)


def test_zerglings_fill_the_ring_round_a_colossus() -> None:
    assert RING == 12
    film = siege(24)
    attack = film.cooldown[-80:, 1:].max(0) > 0
    # Twelve leave 6 degrees between them all: the last place may stay a little too narrow.
    assert RING - 1 <= attack.sum() <= RING
    reach = np.hypot(film.x[-1, 1:] - 10, film.y[-1, 1:] - 16)
    assert (reach[attack] < 1.475 + 0.02).all()
    assert (reach[~attack] > 1.475).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["3m", "2s3z"])
def test_the_enemys_rule_against_itself_is_an_even_fight(name: str) -> None:
    results = tournament.play(make(name), POLICIES["nearest"], jax.random.key(1), 300)
    assert 0.35 < results.won.mean() < 0.7
