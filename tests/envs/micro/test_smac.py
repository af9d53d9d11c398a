"""SMAC's interface against its literal cases, and against a second version in plain Python.

`Smac` below is written from the description of SMAC's code alone, in double precision and with
loops; nothing in it comes from the package.
"""

import copy
import functools
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from race.envs.micro import make, map_names, smac
from race.envs.micro.cases import main

CASES = sorted((Path(__file__).parent / "smac_cases").glob("*.json"))

# Health, shield and SMAC's constant for the cooldown (for healers the energy) of each type.
TYPES = {
    "Stalker": (80, 80, 35),
    "Zealot": (100, 50, 22),
    "Colossus": (200, 150, 24),
    "Marine": (45, 0, 15),
    "Marauder": (125, 0, 25),
    "Medivac": (150, 0, 200),
    "Zergling": (35, 0, 0),
    "Baneling": (30, 0, 0),
    "SpineCrawler": (300, 0, 0),
}


class Table(NamedTuple):
    """What is known of a map. Rectangles are x, y of the lowest and the highest cell."""

    allies: list[str]
    enemies: list[str]
    limit: int
    max_reward: int
    sizes: tuple[int, int, int]  # actions, observation, state
    ally_columns: list[str]
    enemy_columns: list[str]
    open: list[tuple[int, int, int, int]]
    shut: list[tuple[int, int, int, int]]


BAND = [(0, 8, 31, 23)]
TERRANS, SWAPPED = ["Marauder", "Marine", "Medivac"], ["Stalker", "Zealot"]
MMM = 2 * ["Marauder"] + 7 * ["Marine"] + ["Medivac"]
PROTOSS = 2 * ["Stalker"] + 3 * ["Zealot"], 3 * ["Stalker"] + 5 * ["Zealot"]
TABLE = {
    "so_many_baneling": Table(
        *(7 * ["Zealot"], 32 * ["Baneling"], 100, 1480, (38, 202, 397), [], []),
        open=[
            *((22, 28, 29, 29), (20, 24, 29, 27), (16, 22, 29, 23), (14, 18, 25, 21)),
            *((10, 16, 19, 17), (8, 12, 19, 15), (4, 8, 15, 11), (2, 4, 11, 7), (2, 2, 7, 3)),
        ],
        shut=[],
    ),
    "2s3z": Table(
        *(PROTOSS[0], PROTOSS[0], 120, 1020, (11, 80, 120), SWAPPED, SWAPPED[::-1], BAND, []),
    ),
    "2c_vs_64zg": Table(
        *(2 * ["Colossus"], 64 * ["Zergling"], 400, 3080, (70, 332, 342), [], []),
        open=[
            *((8, 18, 23, 19), (2, 16, 29, 17), (0, 14, 31, 15), (0, 12, 3, 13)),
            *((28, 12, 31, 13), (0, 10, 31, 11), (2, 8, 29, 9), (4, 6, 27, 7)),
        ],
        shut=[],
    ),
    "2s_vs_1sc": Table(
        *(2 * ["Stalker"], ["SpineCrawler"], 300, 510, (7, 17, 27), [], [], [(0, 0, 31, 31)]),
        shut=[
            *((10, 24, 17, 25), (8, 22, 11, 23), (16, 22, 19, 23), (6, 20, 9, 21)),
            *((18, 20, 21, 21), (6, 8, 7, 19), (20, 8, 21, 19), (6, 6, 21, 7)),
        ],
    ),
    "MMM": Table(
        *(MMM, 7 * ["Marine"] + 2 * ["Marauder"] + ["Medivac"], 150, 1015, (16, 160, 290)),
        *(TERRANS, TERRANS, BAND, []),
    ),
    "MMM2": Table(
        *(MMM, 8 * ["Marine"] + 3 * ["Marauder"] + ["Medivac"], 180, 1205, (18, 176, 322)),
        *(TERRANS, TERRANS, BAND, []),
    ),
    "3s5z": Table(
        *(PROTOSS[1], PROTOSS[1], 150, 1510, (14, 128, 216), SWAPPED, SWAPPED[::-1], BAND, []),
    ),
    "3s_vs_3z": Table(
        *(3 * ["Stalker"], 3 * ["Zealot"], 150, 680, (9, 36, 54), [], [], [(0, 0, 31, 31)], []),
    ),
}

Columns = dict[str, NDArray[np.float32]]  # x, y, health, shield, energy, cooldown of all units


class Smac:
    """SMAC's reading of a map's units: mask, observations, state, reward and end."""

    def __init__(self, name: str) -> None:
        self.table = table = TABLE[name]
        self.n, self.m = len(table.allies), len(table.enemies)
        self.types = table.allies + table.enemies
        self.medivacs = name.startswith("MMM")
        self.walkable = {
            (x, y)
            for areas, walks in ((table.open, True), (table.shut, False))
            for left, low, right, high in areas
            for x in range(left, right + 1)
            for y in range(low, high + 1)
            if walks and not any(a <= x <= c and b <= y <= d for a, b, c, d in table.shut)
        }

    def see(self, units: Columns, last: NDArray[np.int32]) -> dict[str, NDArray[np.float64]]:
        """Mask, observations and state."""
        self.u = {name: [float(v) for v in column] for name, column in units.items()}
        masks = [self._mask(i) for i in range(self.n)]
        return {
            "avail_actions": np.array(masks, float),
            "obs": np.array([self._obs(i, masks[i]) for i in range(self.n)], float),
            "state": np.array(self._state(last), float),
        }

    def _distance(self, i: int, j: int) -> float:
        return math.hypot(self.u["x"][j] - self.u["x"][i], self.u["y"][j] - self.u["y"][i])

    def _mask(self, i: int) -> list[int]:
        mask = (6 + self.m) * [0]
        if self.u["health"][i] == 0:
            mask[0] = 1
            return mask
        mask[1] = 1
        x, y = self.u["x"][i], self.u["y"][i]
        for action, (px, py) in enumerate(((x, y + 1), (x, y - 1), (x + 1, y), (x - 1, y)), 2):
            mask[action] = int((math.trunc(px), math.trunc(py)) in self.walkable)
        heals = self.medivacs and self.types[i] == "Medivac"
        for k in range(self.n if heals else self.m):
            other = k if heals else self.n + k
            if heals and self.types[other] == "Medivac":
                continue
            mask[6 + k] = int(self.u["health"][other] > 0 and self._distance(i, other) <= 6)
        return mask

    def _traits(self, k: int, between: tuple[float, ...] = ()) -> list[float]:
        health, shield, _ = TYPES[self.types[k]]
        side = self.table.allies if k < self.n else self.table.enemies
        columns = self.table.ally_columns if k < self.n else self.table.enemy_columns
        row = [self.u["health"][k] / health, *between]
        if TYPES[side[0]][1]:
            row.append(self.u["shield"][k] / shield)
        return row + [float(self.types[k] == column) for column in columns]

    def _obs(self, i: int, mask: list[int]) -> list[float]:
        obs: list[float] = list(map(float, mask[2:6]))
        others = [*range(self.n, self.n + self.m), *(k for k in range(self.n) if k != i)]
        for k in others:
            d = self._distance(i, k)
            row = [
                mask[6 + k - self.n] if k >= self.n else 1,
                d / 9,
                (self.u["x"][k] - self.u["x"][i]) / 9,
                (self.u["y"][k] - self.u["y"][i]) / 9,
                *self._traits(k),
            ]
            seen = self.u["health"][k] > 0 and d < 9
            obs += row if seen else len(row) * [0.0]
        obs += self._traits(i)
        return obs if self.u["health"][i] > 0 else len(obs) * [0.0]

    def _state(self, last: NDArray[np.int32]) -> list[float]:
        state: list[float] = []
        for k, kind in enumerate(self.types):
            place = ((self.u["x"][k] - 16) / 32, (self.u["y"][k] - 16) / 32)
            if k < self.n:
                charge = self.u["energy" if kind == "Medivac" else "cooldown"][k] / TYPES[kind][2]
                place = (charge, *place)  # type: ignore[assignment]
            row = self._traits(k, place)
            state += row if self.u["health"][k] > 0 else len(row) * [0.0]
        for action in last:
            state += [float(action == a) for a in range(6 + self.m)]
        return state

    def judge(self, old: Columns, new: Columns, steps: int) -> dict[str, float]:
        """Reward, end and info of the step from the old units to the new ones."""
        n = self.n
        alive = [health > 0 for health in new["health"]]
        total = 0.0
        for k in range(n, n + self.m):
            had = float(old["health"][k]) + float(old["shield"][k])
            if old["health"][k] > 0 and not alive[k]:
                total += had + 10
            elif old["health"][k] > 0:
                total += had - (float(new["health"][k]) + float(new["shield"][k]))
        reward = abs(total)
        own = [self.types[k] for k in range(n) if alive[k]]
        foes = [self.types[k] for k in range(n, n + self.m) if alive[k]]
        code: int | None = None
        if (not own and foes) or (self.medivacs and all(kind == "Medivac" for kind in own)):
            code = -1
        elif (own and not foes) or (self.medivacs and foes == ["Medivac"]):
            code = 1
        elif not own and not foes:
            code = 0
        if code == 1:
            reward += 200
        return {
            "reward": reward / (self.table.max_reward / 20),
            "terminated": code is not None or steps >= self.table.limit,
            "battle_won": code == 1,
            "dead_allies": n - len(own),
            "dead_enemies": self.m - len(foes),
            "timed_out": code is None and steps >= self.table.limit,
        }


# Random situations.


def situation(table: Table, rng: np.random.Generator) -> Columns:
    """Units anywhere on the map: scattered, crowded, on a lattice or along the border."""
    types = table.allies + table.enemies
    n, units = len(table.allies), len(types)
    x, y = rng.uniform(0, 32, (2, units))
    style = rng.integers(5)
    if style == 1:  # most see each other
        x, y = rng.uniform(0, 32, (2, 1)) + rng.normal(0, 4, (2, units))
    elif style == 2:  # distances of exactly 6 and 9, and corners of cells
        x, y = np.floor([x, y]) + rng.choice([0.0, 0.0, 0.5])
    elif style == 3:  # the corner, where cutting towards zero shows
        x, y = x % 2, y % 2
    elif style == 4:  # one line
        y = np.floor(x[:1] + 0 * y)
        x = np.floor(4 * x) / 4
    whole, shields, _ = np.array([TYPES[kind] for kind in types]).T
    health = whole * rng.choice([0.001, 1.0, rng.uniform(0.01, 1)], units, p=[0.1, 0.5, 0.4])
    health = np.where(rng.random(units) < rng.choice([0.0, 0.2, 0.7]), 0.0, health)
    columns = {
        "x": np.clip(x, 0, 32),
        "y": np.clip(y, 0, 32),
        "health": kill(types, n, health, rng),
        "shield": shields * rng.choice([0.0, 1.0, rng.uniform()], units),
        "energy": np.where(np.array(types) == "Medivac", rng.uniform(0, 200, units), 0.0),
        "cooldown": rng.choice([0.0, rng.uniform(0, 37)], units),
    }
    return {name: column.astype(np.float32) for name, column in columns.items()}


def kill(types: list[str], n: int, health: NDArray[Any], rng: np.random.Generator) -> NDArray[Any]:
    """Often one side, both, or all of a side but its Medivac or one other unit are dead."""
    health = health.copy()
    for side in (np.arange(n), np.arange(n, len(types))):
        left = rng.choice(["as it is", "as it is", "nobody", "Medivac", "one"])
        if left == "as it is":
            continue
        health[side] = 0.0
        medivacs = [k for k in side if types[k] == "Medivac"]
        if left == "Medivac" and medivacs:
            health[medivacs] = 150.0
        elif left != "nobody":
            health[rng.choice(side)] = 7.5
    return health


def later(table: Table, old: Columns, rng: np.random.Generator) -> Columns:
    """Any units a step later; the dead stay dead."""
    new = situation(table, rng)
    if rng.random() < 0.3:  # nothing but regeneration
        new = {**old, "health": old["health"] * np.float32(0.9), "shield": old["shield"] + 1}
        old["health"] *= np.float32(0.85)
    new["health"] = np.where(old["health"] > 0, new["health"], np.float32(0))
    return new


def blurred(n: int, units: Columns) -> bool:
    """Whether a distance is too near a threshold, and not on it, for single precision."""
    place = np.stack([units["x"], units["y"]], 1).astype(float)
    distance = np.linalg.norm(place[:n, None] - place[None], axis=-1)
    off = np.abs(distance[..., None] - np.array([6.0, 9.0]))
    return bool(((off > 0) & (off < 1e-4)).any())


_observe = jax.jit(jax.vmap(smac.observe, in_axes=(None, 0, 0)))
_judge = jax.jit(jax.vmap(smac.judge, in_axes=(None, 0, 0, 0)))
BATCH = 48


def views(batch: list[Columns]) -> smac.View:
    return smac.View(*(jnp.stack([c[field] for c in batch]) for field in smac.View._fields))


def assert_agree(
    theirs: dict[str, Any], ours: Callable[[str], Any], situation: Columns, what: str = ""
) -> None:
    for quantity, value in theirs.items():
        difference = np.abs(np.asarray(ours(quantity), np.float64) - value).max()
        assert difference <= 1e-5, (quantity, what, situation)


def compare(name: str, seed: int) -> set[str]:
    """Compares a batch; what kinds of situation were in it."""
    rng, table, theirs = np.random.default_rng(seed), TABLE[name], Smac(name)
    old = [situation(table, rng) for _ in range(BATCH)]
    new = [later(table, units, rng) for units in old]
    last = rng.integers(-1, 6 + theirs.m, (BATCH, theirs.n)).astype(np.int32)
    steps = rng.choice([1, table.limit - 1, table.limit, table.limit + 1], BATCH)
    scenario = make(name).scenario
    shown = _observe(scenario, views(new), jnp.asarray(last))
    judged = _judge(scenario, views(old), views(new), jnp.asarray(steps, jnp.int32))
    reward, terminated, info = (jax.tree.map(np.asarray, part) for part in judged)
    shown = jax.tree.map(np.asarray, shown)
    kinds = set()
    for k in range(BATCH):
        result = theirs.judge(old[k], new[k], int(steps[k]))
        ours = {"reward": reward[k], "terminated": terminated[k]}
        ours |= {fact: getattr(info, fact)[k] for fact in info._fields}
        assert_agree(result, ours.__getitem__, new[k], f"steps {steps[k]}")
        kinds |= {fact for fact in ("battle_won", "timed_out") if result[fact]}
        kinds |= {"lost or drawn"} if result["terminated"] > result["battle_won"] else set()
        kinds |= {"end at the limit"} if result["battle_won"] and steps[k] >= table.limit else set()
        if not blurred(theirs.n, new[k]):
            seen = theirs.see(new[k], last[k])
            assert_agree(seen, lambda name, k=k: getattr(shown, name)[k], new[k])  # type: ignore[misc]
            kinds |= {"seen"} if seen["obs"].any() else set()
    return kinds


@pytest.mark.parametrize("name", map_names())
def test_agrees_with_a_second_version(name: str) -> None:
    kinds: set[str] = set()

    @settings(max_examples=5, derandomize=True, deadline=None, phases=[Phase.generate])
    @given(st.integers(0, 2**32 - 1))
    def run(seed: int) -> None:
        kinds.update(compare(name, seed))

    run()
    assert kinds == {"battle_won", "timed_out", "lost or drawn", "end at the limit", "seen"}


@pytest.mark.slow
@pytest.mark.parametrize("name", map_names())
@settings(max_examples=200, derandomize=True, deadline=None, phases=[Phase.generate])
@given(st.integers(0, 2**32 - 1))
def test_agrees_with_a_second_version_at_length(name: str, seed: int) -> None:
    compare(name, seed)


# Chosen situations.


def plain(name: str, **columns: Any) -> Columns:
    """Whole units far apart, but for the given columns; a dict sets single units."""
    types = TABLE[name].allies + TABLE[name].enemies
    whole, shields, _ = np.array([TYPES[kind] for kind in types]).T
    k = np.arange(len(types))
    units = {"x": 1.5 + k % 16 * 2, "y": 9.5 + k // 16 * 3.0, "health": whole, "shield": shields}
    units |= {"energy": 0 * whole, "cooldown": 0 * whole}
    units = {field: np.array(column, np.float32) for field, column in units.items()}
    for field, values in columns.items():
        for unit, value in values.items():
            units[field][unit] = value
    return units


def see(name: str, units: Columns) -> smac.Observation:
    last = jnp.full((1, len(TABLE[name].allies)), -1, jnp.int32)
    shown: smac.Observation = _observe(make(name).scenario, views([units]), last)
    theirs = Smac(name).see(units, np.asarray(last[0]))
    assert_agree(theirs, lambda quantity: getattr(shown, quantity)[0], units)
    return jax.tree.map(lambda leaf: np.asarray(leaf[0]), shown)


def judge(name: str, old: Columns, new: Columns, steps: int = 1) -> dict[str, Any]:
    judged = _judge(make(name).scenario, views([old]), views([new]), jnp.array([steps]))
    reward, terminated, info = jax.tree.map(lambda leaf: np.asarray(leaf[0]), judged)
    ours = {"reward": reward, "terminated": terminated} | info._asdict()
    assert_agree(Smac(name).judge(old, new, steps), ours.__getitem__, new)
    return ours


def test_worked_example() -> None:
    """An agent at (10, 16), a Zealot at (14, 19) with 80 health and 20 shield."""
    x, y = {0: 10, 1: 30, 2: 30, 3: 14, 4: 1, 5: 1}, {0: 16, 1: 1, 2: 2, 3: 19, 4: 1, 5: 2}
    units = plain("3s_vs_3z", x=x, y=y, health={3: 80}, shield={3: 20})
    shown = see("3s_vs_3z", units)
    assert shown.avail_actions[0, 6]
    row = [1, 0.555556, 0.444444, 0.333333, 0.8, 0.4]
    np.testing.assert_allclose(shown.obs[0, 4:10], row, atol=1e-6)
    np.testing.assert_allclose(shown.state[15:19], [0.8, -0.0625, 0.09375, 0.4], atol=1e-6)
    grown = units | {"shield": units["shield"] + np.eye(6, dtype=np.float32)[3]}
    assert judge("3s_vs_3z", units, grown)["reward"] == pytest.approx(0.029412, abs=1e-6)
    dead = units | {"health": units["health"] * (np.arange(6) != 3)}
    assert judge("3s_vs_3z", units, dead)["reward"] == pytest.approx(3.235294, abs=1e-6)
    alone = units | {"health": units["health"] * (np.arange(6) < 4)}
    won = judge("3s_vs_3z", alone, alone | {"health": alone["health"] * (np.arange(6) < 3)})
    assert won["reward"] == pytest.approx(3.235294 + 5.882353, abs=2e-6)
    assert won["battle_won"]


@pytest.mark.parametrize(
    ("dx", "shoots", "sees"),
    [(5.999, 1, 1), (6.0, 1, 1), (6.001, 0, 1), (8.999, 0, 1), (9.0, 0, 0), (9.001, 0, 0)],
)
@pytest.mark.parametrize("across", [False, True])
def test_thresholds(dx: float, shoots: int, sees: int, across: bool) -> None:
    places: Any = ({0: 10, 3: 10 + dx}, {0: 16, 3: 16})
    x, y = places[::-1] if across else places
    shown = see("3s_vs_3z", plain("3s_vs_3z", x=x, y=y))
    assert (shown.avail_actions[0, 6], shown.obs[0, 4:10].any()) == (bool(shoots), bool(sees))


@pytest.mark.parametrize("place", [0.0, 0.25, 0.999, 1.0, 1.5, 30.999, 31.0, 31.5, 32.0])
def test_moves_on_the_rim(place: float) -> None:
    """A probe is cut towards zero: from x < 1 the way west is offered, from 0 it is not."""
    shown = see("3s_vs_3z", plain("3s_vs_3z", x={0: place, 1: 16}, y={0: 16, 1: place}))
    on, on_outwards, inwards = place < 32, place < 31, place > 0
    assert shown.avail_actions[0, 2:6].tolist() == [on, on, on_outwards, inwards]
    assert shown.avail_actions[1, 2:6].tolist() == [on_outwards, inwards, on, on]


@pytest.mark.xfail(strict=True, reason="x - 1 is rounded to -1 in single precision")
def test_moves_from_the_very_rim() -> None:
    """SMAC subtracts in double precision: -1 + 1e-9 is cut to 0, where there is ground."""
    see("3s_vs_3z", plain("3s_vs_3z", x={0: 1e-9}, y={0: 16}))


def test_medivac_rules() -> None:
    """Agent 9 and enemy 9 of MMM are Medivacs; the own rule comes first."""
    whole = plain("MMM")
    side = np.arange(20) < 10
    medivac = np.arange(20) % 10 == 9

    def end(lives: NDArray[np.bool_]) -> tuple[bool, bool]:
        ended = judge("MMM", whole, whole | {"health": whole["health"] * lives})
        return bool(ended["terminated"]), bool(ended["battle_won"])

    assert end(side | medivac) == (True, True)
    assert end(side) == (True, True)
    assert end(~side | medivac) == (True, False)
    assert end(side & medivac) == (True, False)
    assert end(medivac) == (True, False)
    assert end(~side) == (True, False)
    assert end(0 * side > 0) == (True, False)
    assert end(side | (np.arange(20) == 10)) == (False, False)
    assert end(np.isin(np.arange(20), [0, 10, 11])) == (False, False)


def test_a_healer_names_agents() -> None:
    units = plain("MMM", x=dict.fromkeys(range(20), 16.0), y=dict.fromkeys(range(20), 16.0))
    units["health"][[1, 12]] = 0
    mask = see("MMM", units).avail_actions
    assert mask[9, 6:].tolist() == [True, False, *(7 * [True]), False]
    assert mask[0, 6:].tolist() == [True, True, False, *(7 * [True])]
    assert mask[1].tolist() == [True] + 15 * [False]
    assert not see("MMM", units).obs[1].any()


def test_an_end_in_the_last_step_is_no_time_out() -> None:
    whole = plain("2s3z")
    late = TABLE["2s3z"].limit
    won = whole | {"health": whole["health"] * (np.arange(10) < 5)}
    ended = judge("2s3z", whole, won, late)
    assert ended["battle_won"]
    assert not ended["timed_out"]
    assert ended["reward"] == pytest.approx(20, rel=1e-6)
    nobody = judge("2s3z", whole, whole | {"health": 0 * whole["health"]}, late)
    assert not nobody["battle_won"]
    assert not nobody["timed_out"]
    assert nobody["terminated"]
    assert judge("2s3z", whole, whole, late)["timed_out"]
    assert not judge("2s3z", whole, whole, late - 1)["terminated"]


# Shapes, steps and the program that compares cases.


@pytest.mark.parametrize("name", map_names())
def test_shapes(name: str) -> None:
    battle, table = make(name), TABLE[name]
    shape = battle.shape
    assert (shape.n_allies, shape.n_enemies) == (len(table.allies), len(table.enemies))
    assert (shape.n_actions, shape.obs_size, shape.state_size) == table.sizes
    assert battle.spec.episode_limit == table.limit
    _, shown = battle.reset(jax.random.key(0))
    assert shown.obs.shape == (shape.n_allies, shape.obs_size)
    assert shown.state.shape == (shape.state_size,)
    assert shown.avail_actions.shape == (shape.n_allies, shape.n_actions)


def columns(env_state: Any) -> Columns:
    return {field: np.array(getattr(env_state.units, field)) for field in smac.View._fields}


@pytest.mark.parametrize("name", ["MMM"])
def test_steps_show_what_the_second_version_makes_of_the_units(name: str) -> None:
    battle, theirs = make(name), Smac(name)
    rng = np.random.default_rng(0)
    env_state, shown = battle.reset(jax.random.key(0))
    start = theirs.see(columns(env_state), np.full(theirs.n, -1, np.int32))
    assert_agree(start, functools.partial(getattr, shown), columns(env_state))
    assert not shown.state[-theirs.n * (6 + theirs.m) :].any()
    hurt = 0.0
    for number in range(1, 31):
        # Towards the enemy, who comes as well; then whom they can reach.
        chances = np.asarray(shown.avail_actions) * np.array([1, 1, 1, 1, 4, 1] + theirs.m * [9])
        actions = (chances * rng.random(chances.shape)).argmax(1).astype(np.int32)
        old = columns(env_state)
        env_state, timestep = battle.step(env_state, actions, jax.random.key(number))
        shown, new = timestep.observation, columns(env_state)
        assert_agree(theirs.see(new, actions), functools.partial(getattr, shown), new)
        facts = {"reward": timestep.reward, "terminated": timestep.terminated}
        facts |= timestep.info._asdict()
        assert_agree(theirs.judge(old, new, number), facts.__getitem__, new)
        assert not timestep.info.refused.any()
        hurt += float(timestep.reward)
        if timestep.terminated:
            break
    assert hurt > 0


def test_every_case_of_smac_agrees(capsys: pytest.CaptureFixture[str]) -> None:
    assert len(CASES) == 8
    assert main([str(path) for path in CASES]) == 0
    output = capsys.readouterr().out
    assert all(str(path) in output for path in CASES)
    assert "differs" not in output


@functools.cache
def case_text(name: str) -> str:
    return (CASES[0].parent / f"{name}.json").read_text()


def changed(tmp_path: Path, change: Callable[[dict[str, Any]], object], name: str = "MMM") -> str:
    table = json.loads(case_text(name))
    change(table)
    path = tmp_path / "changed.json"
    path.write_text(json.dumps(table))
    return str(path)


def frame(table: dict[str, Any]) -> dict[str, Any]:
    chosen: dict[str, Any] = table["cases"][1]["frames"][-1]
    return chosen


def add(row: list[Any], k: int, value: float) -> None:
    row[k] += value


@pytest.mark.parametrize(
    ("quantity", "change"),
    [
        ("obs", lambda t: add(frame(t)["obs"][0], -1, 2e-5)),
        ("obs", lambda t: frame(t)["obs"].pop()),
        ("state", lambda t: add(frame(t)["state"], 1, -2e-5)),
        ("state", lambda t: add(frame(t)["state"], 1, math.nan)),
        ("avail_actions", lambda t: add(frame(t)["avail"][3], 0, -1)),
        ("reward", lambda t: t["cases"][0]["frames"][-1].update(reward=3.0)),
        ("terminated", lambda t: frame(t).update(terminated=False)),
        ("info.battle_won", lambda t: frame(t)["info"].update(battle_won=False)),
        ("info.dead_allies", lambda t: frame(t)["info"].update(dead_allies=5)),
        ("info.episode_limit", lambda t: frame(t)["info"].update(episode_limit=True)),
        ("stats.battles_draw", lambda t: t["cases"][1]["stats_after"].update(battles_draw=1)),
        ("obs_size", lambda t: t.update(obs_size=161)),
        ("episode_limit", lambda t: t.update(episode_limit=149)),
    ],
)
def test_a_wrong_value_is_named(
    quantity: str, change: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([changed(tmp_path, change)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines if "differs" in line] == [quantity]
    assert lines[-1] == "not all within 1e-5"


def test_one_wrong_file_among_good_ones(tmp_path: Path) -> None:
    wrong = changed(tmp_path, lambda t: t.update(n_actions=17))
    good = str(CASES[-1])
    assert main([good, wrong, good]) == 1
    assert main([good, good]) == 0


@pytest.mark.parametrize(
    "change",
    [
        lambda t: t.update(map="3s4z"),
        lambda t: t.pop("map"),
        lambda t: t.pop("cases"),
        lambda t: t.pop("obs_size"),
        lambda t: frame(t).pop("obs"),
        lambda t: frame(t).pop("units"),
        lambda t: frame(t)["units"][0].pop("x"),
        lambda t: frame(t).update(units=3),
        lambda t: frame(t).update(actions="north"),
        lambda t: t["cases"][0].update(agent_tags=[1, 2]),
        lambda t: t["cases"][0].update(enemy_tags=None),
        lambda t: t["cases"][0].update(episode_steps_before_first_step="many"),
        lambda t: frame(t).update(obs="nothing"),
        lambda t: frame(t)["obs"][0].pop(),
        pytest.param(
            lambda t: frame(t).update(info=None),
            marks=pytest.mark.xfail(strict=True, reason="AttributeError"),
        ),
        lambda t: t.update(map=3),
        lambda t: t.update(cases=3),
    ],
)
def test_unusable_cases(change: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = changed(tmp_path, change)
    assert main([path]) == 2
    assert f"{path}: no usable cases" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["", "{", "[]", "3", "null", '"MMM"', "{}", "\x00"])
def test_files_without_cases(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "broken.json"
    path.write_text(text)
    assert main([str(path)]) == 2
    assert main([str(tmp_path)]) == 2
    assert main([str(tmp_path / "missing.json")]) == 2
    assert capsys.readouterr().err.count("no usable cases: ") == 3


def test_units_of_the_next_battle_are_ignored(tmp_path: Path) -> None:
    """When all are dead the map creates new units, with tags that SMAC does not know."""

    def respawn(table: dict[str, Any]) -> None:
        for case in table["cases"]:
            born = copy.deepcopy(case["frames"][0]["units"])
            for unit in born:
                unit["tag"] += 10_000
            case["frames"][-1]["units"] += born

    assert main([changed(tmp_path, respawn, "so_many_baneling")]) == 0
    assert main([changed(tmp_path, respawn, "MMM")]) == 0
