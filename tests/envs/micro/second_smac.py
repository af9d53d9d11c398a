"""SMAC's interface in plain Python: a second version, and random situations to compare it in.

`Smac` is written from the description of SMAC's code alone, in double precision and with loops;
nothing in it comes from the package.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

# Health, shield and SMAC's constant for the cooldown (for healers the energy) of each type.
TYPES = {
    "Stalker": (80, 80, 35),
    "Zealot": (100, 50, 22),
    "Colossus": (200, 150, 24),
    "Marine": (45, 0, 15),
    "Marauder": (125, 0, 25),
    "Medivac": (150, 0, 200),
    "Zergling": (35, 0, 11),
    "Baneling": (30, 0, 1),
    "Hydralisk": (80, 0, 10),
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

HALVES = {
    "octagon": [
        *((10, 6, 21, 6), (9, 7, 22, 7), (8, 8, 23, 8), (7, 9, 24, 9), (6, 10, 25, 21)),
        *((7, 22, 24, 22), (8, 23, 23, 23), (9, 24, 22, 24), (10, 25, 21, 25)),
    ],
    "room": [
        *((0, 0, 31, 5), (0, 6, 7, 7), (22, 6, 31, 7), (0, 8, 5, 19), (10, 8, 19, 8)),
        *((24, 8, 31, 19), (9, 9, 20, 9), (8, 10, 21, 17), (9, 18, 20, 18), (10, 19, 19, 19)),
        *((0, 20, 7, 21), (22, 20, 31, 21), (0, 22, 31, 31)),
    ],
    "corridor": [
        *((2, 2, 11, 10), (2, 11, 12, 11), (11, 12, 13, 12), (12, 13, 14, 13), (13, 14, 25, 14)),
        *((14, 15, 26, 15), (14, 16, 27, 16), (13, 17, 28, 17), (12, 18, 29, 21)),
        *((13, 22, 29, 22), (14, 23, 29, 23), (15, 24, 29, 24), (16, 25, 29, 25)),
        *((17, 26, 29, 26), (18, 27, 29, 27), (19, 28, 29, 28), (20, 29, 29, 29)),
    ],
}
"""Grounds with half tiles, which count as ground."""
ALL = [(0, 0, 31, 31)]
BOTH = ["Baneling", "Zergling"]
THIRD = ["Colossus"] + 3 * ["Stalker"] + 5 * ["Zealot"]
FOES = 3 * ["Stalker"] + 6 * ["Zealot"]
BANES = 4 * ["Baneling"] + 20 * ["Zergling"]


def marines(allies: int, enemies: int, limit: int, reward: int, *sizes: int) -> Table:
    sides = allies * ["Marine"], enemies * ["Marine"]
    return Table(*sides, limit, reward, sizes, [], [], BAND, [])  # type: ignore[arg-type]


TABLE |= {
    "3m": marines(3, 3, 60, 365, 9, 30, 48),
    "8m": marines(8, 8, 120, 640, 14, 80, 168),
    "25m": marines(25, 25, 150, 1575, 31, 250, 950),
    "5m_vs_6m": marines(5, 6, 70, 530, 12, 55, 98),
    "8m_vs_9m": marines(8, 9, 120, 695, 15, 85, 179),
    "10m_vs_11m": marines(10, 11, 150, 805, 17, 105, 243),
    "27m_vs_30m": marines(27, 30, 180, 1850, 36, 285, 1170),
    "3s_vs_4z": Table(
        *(3 * ["Stalker"], 4 * ["Zealot"], 200, 840, (10, 42, 61), [], [], ALL, []),
    ),
    "3s_vs_5z": Table(
        *(3 * ["Stalker"], 5 * ["Zealot"], 250, 1000, (11, 48, 68), [], [], ALL, []),
    ),
    "2m_vs_1z": Table(
        *(2 * ["Marine"], ["Zealot"], 150, 360, (7, 16, 26), [], [], HALVES["octagon"], []),
    ),
    "1c3s5z": Table(
        *(THIRD, THIRD, 180, 1870, (15, 162, 270)),
        *(["Colossus", "Stalker", "Zealot"], ["Colossus", "Stalker", "Zealot"], BAND, []),
    ),
    "3s5z_vs_3s6z": Table(
        *(PROTOSS[1], FOES, 170, 1670, (15, 136, 230), SWAPPED, SWAPPED[::-1], BAND, []),
    ),
    "bane_vs_bane": Table(
        *(BANES, BANES[4:] + BANES[:4], 200, 1260, (30, 336, 984)),
        *(BOTH, BOTH, HALVES["octagon"], []),
    ),
    "6h_vs_8z": Table(
        *(6 * ["Hydralisk"], 8 * ["Zealot"], 150, 1480, (14, 78, 140), [], [], HALVES["room"], []),
    ),
    "corridor": Table(
        *(6 * ["Zealot"], 24 * ["Zergling"], 400, 1280, (30, 156, 282)),
        *([], [], HALVES["corridor"], []),
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
