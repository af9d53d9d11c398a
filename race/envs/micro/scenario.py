"""A map as arrays: everything about its units and its ground that does not change in a battle.

Units have one numbering, allies first (in SMAC's order of agents), then enemies. Times are in game
loops, speeds in cells per game loop.
"""

import functools
from dataclasses import dataclass, field
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from race.envs.micro.maps import MapSpec
from race.envs.micro.terrain import Terrain, survey
from race.envs.micro.units import GROUND, LOOPS_PER_SECOND, UNIT_TYPES, Mover, UnitType, Weapon

SCAN_RANGE: Final = 5.0
"""How near, edge to edge, an ally must come before an enemy with a shorter weapon attacks it."""
SCAN_PERIOD: Final = 8
"""Game loops between two looks of an enemy for a target; every enemy looks at moments of its own,
drawn for each battle.

How often units look is not documented. At half a second, which is how often agents may choose,
the enemy's own rule played by the agents wins about half of even fights (docs/micro.md)."""
REWARD_DEATH: Final = 10.0
REWARD_WIN: Final = 200.0
REWARD_SCALE: Final = 20.0
"""SMAC divides rewards by the highest return over this."""
APART: Final = -1e6
"""A contact distance of units that pass each other."""

_UNARMED: Final = Weapon(damage=0.0, period=1.0, range=0.0)


@dataclass(frozen=True)
class Shape:
    """What a compiled program depends on: sizes, and which mechanics a map needs. Hashable.

    Maps of equal shape share their compiled programs.
    """

    n_allies: int
    n_enemies: int
    n_types: int
    """One-hot columns of unit types T."""
    ally_shields: bool
    enemy_shields: bool
    n_healers: int
    n_beams: int
    ally_bursts: bool
    enemy_bursts: bool
    flyers: bool
    plain: bool
    """Whether the ground of every unit is one rectangle."""
    width: int
    height: int
    ground: int
    """Length of the tables of ways; 0 on a plain map."""
    ally_heals: bool
    """Whether agents have healers, whose actions name agents."""

    @property
    def n_units(self) -> int:
        """Allies and enemies."""
        return self.n_allies + self.n_enemies

    @property
    def n_actions(self) -> int:
        """No-op, stop, four moves, and one attack per enemy."""
        return 6 + self.n_enemies

    @property
    def obs_size(self) -> int:
        """Entries of an agent's observation."""
        enemy = 5 + self.enemy_shields + self.n_types
        ally = 5 + self.ally_shields + self.n_types
        return 4 + self.n_enemies * enemy + (self.n_allies - 1) * ally + ally - 4

    @property
    def state_size(self) -> int:
        """Entries of the global state."""
        ally = 4 + self.ally_shields + self.n_types
        enemy = 3 + self.enemy_shields + self.n_types
        return self.n_allies * (ally + self.n_actions) + self.n_enemies * enemy


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Scenario:
    """The arrays of a map. ``U`` units, ``n`` allies, ``m`` enemies; a pytree."""

    shape: Shape = field(metadata={"static": True})

    # Bodies.
    x: Float[Any, "U"]
    y: Float[Any, "U"]
    max_health: Float[Any, "U"]
    max_shield: Float[Any, "U"]
    radius: Float[Any, "U"]
    speed: Float[Any, "U"]
    acceleration: Float[Any, "U"]
    bounds: Float[Any, "4 U"]
    """Lowest x, highest x, lowest y, highest y of the centre on a plain map."""
    regeneration: Float[Any, "U"]
    flying: Bool[Any, "U"]
    biological: Bool[Any, "U"]
    """Whether healers mend it: biological, and no structure."""
    inner_radius: Float[Any, "U"]
    healers: Int[Any, "healers"]

    # Weapons.
    weapon_air: Bool[Any, "U"]
    armed: Bool[Any, "U"]
    range: Float[Any, "U"]
    slop: Float[Any, "U"]
    period: Float[Any, "U"]
    damage_point: Float[Any, "U"]
    """Whole loops: an attack that waits for its cooldown aims in the cooldown's last ones."""
    backswing: Float[Any, "U"]
    hits: Float[Any, "U"]
    """Hits that come together."""
    second_hit: Float[Any, "U"]
    """Loops to the second hit; 0 without one."""
    delay: Float[Any, "U"]
    loops_per_cell: Float[Any, "U"]
    missile: Bool[Any, "U"]
    beams: Int[Any, "beams"]
    bursting: Bool[Any, "U"]
    burst_reach: Float[Any, "U U"]
    """Centre distance within which a burst strikes; 0 for units that do not burst."""
    damage: Float[Any, "U U"]
    """Damage of one hit on full health, [attacker, target]; 0 among friends and out of reach."""
    armour: Float[Any, "U"]
    burst_damage: Float[Any, "U U"]
    burst_armour: Float[Any, "U U"]

    # The opponent.
    scan: Float[Any, "m n"]
    """Square of the centre distance within which enemies find targets."""
    scan_period: Int[Any, ""]
    """Game loops between two looks of an enemy for a target."""
    reach: Float[Any, "m n"]
    """Square of the centre distance at which enemies hit allies."""
    reluctance: Float[Any, "m n"]
    """Added to the square of the distance: targets that cannot strike back come last, impossible
    ones (infinity) never."""
    goal_x: Float[Any, "m"]
    """Where an enemy walks that has nothing to fight."""
    goal_y: Float[Any, "m"]
    goal_spread: Float[Any, "goals 2"]
    """Half of the segment from which a battle's goals are drawn; none where they are fixed."""

    # Crowding.
    contact: Float[Any, "U U"]
    """Centre distance at which two units on the ground touch; `APART` if they pass each other."""
    air_contact: Float[Any, "U U"]
    """The same where one of the two flies; there they only drift apart."""

    # SMAC's features.
    cooldown_scale: Float[Any, "n"]
    healing_columns: Bool[Any, "n"]
    """Whether a unit shows its energy in place of its cooldown, and its actions name agents."""
    enemy_heals: Bool[Any, "m"]
    ally_types: Float[Any, "n T"]
    enemy_types: Float[Any, "m T"]

    # The ground.
    mover: Int[Any, "U"]
    walkable: Bool[Any, "X Y"]
    walls: Int[Any, "K X Y"]
    node: Int[Any, "K _ _"]
    ways: Int[Any, "K _ _"]
    centre: Float[Any, "K _ 2"]

    episode_limit: Int[Any, ""]
    reward_scale: Float[Any, ""]
    """What rewards are divided by, so that a win without regeneration returns 20."""


@functools.cache
def build(spec: MapSpec) -> Scenario:
    """The arrays of a map, on the default device."""
    with jax.ensure_compile_time_eval():
        return jax.tree.map(jnp.asarray, _build(spec))


def _build(spec: MapSpec) -> Scenario:
    starts = (*spec.allies, *spec.enemies)
    types = [UNIT_TYPES[start.unit] for start in starts]
    n, units = len(spec.allies), len(starts)
    weapons = [t.weapon or _UNARMED for t in types]
    places = np.array([[s.x, s.y] for s in starts])
    ground = survey(spec.cells, tuple(sorted({t.mover for t in types})), places)
    burst_damage, burst_armour = _bursts(types, n)
    damage = _damage(types, n)
    contact, air_contact = _contacts(types)
    goals = _goals(spec, places)
    structure = [0.0 if "structure" in t.attributes else 1.0 for t in types]
    return Scenario(
        shape=_shape(spec, types, n, ground),
        x=_f([s.x for s in starts]),
        y=_f([s.y for s in starts]),
        max_health=_f([t.health for t in types]),
        max_shield=_f([t.shield for t in types]),
        radius=_f([t.radius for t in types]),
        speed=_f([t.speed * s for t, s in zip(types, structure, strict=True)]) / LOOPS_PER_SECOND,
        acceleration=_f([t.acceleration for t in types]) / LOOPS_PER_SECOND**2,
        bounds=_bounds(types, ground),
        regeneration=_f([t.health_regeneration for t in types]) / LOOPS_PER_SECOND,
        flying=np.array([t.mover is Mover.AIR for t in types]),
        biological=np.array(
            ["biological" in t.attributes and "structure" not in t.attributes for t in types]
        ),
        inner_radius=_f([t.inner_radius for t in types]),
        healers=np.array([i for i, t in enumerate(types) if t.heals], np.int32),
        weapon_air=np.array([w.air for w in weapons]),
        armed=np.array([t.weapon is not None for t in types]),
        range=_f([w.range for w in weapons]),
        slop=_f([w.slop for w in weapons]),
        period=_loops([w.period for w in weapons]),
        damage_point=np.ceil(_loops([w.damage_point for w in weapons])),
        backswing=_loops([w.backswing for w in weapons]),
        hits=_f([1.0 if w.second_hit > 0 else w.hits for w in weapons]),
        second_hit=_loops([w.second_hit for w in weapons]),
        delay=_loops([w.delay for w in weapons]),
        loops_per_cell=_f(
            [LOOPS_PER_SECOND / w.missile_speed if w.missile_speed else 0.0 for w in weapons]
        ),
        missile=np.array([w.missile_speed > 0 for w in weapons]),
        beams=np.array([i for i, w in enumerate(weapons) if w.beam], np.int32),
        bursting=np.array([w.burst > 0 for w in weapons]),
        burst_reach=_f([[a.burst + t.radius if a.burst else 0.0 for t in types] for a in weapons]),
        damage=damage,
        armour=_f([t.armour for t in types]),
        burst_damage=burst_damage,
        burst_armour=burst_armour,
        scan=_reach(types, n, np.inf if spec.enemy_order.kind == "attack_nearest" else SCAN_RANGE),
        scan_period=np.array(SCAN_PERIOD, np.int32),
        reach=_reach(types, n, 0.0),
        reluctance=_reluctance(types, n, damage),
        goal_x=_f(goals[n:, 0]),
        goal_y=_f(goals[n:, 1]),
        goal_spread=_spread(spec),
        contact=contact,
        air_contact=air_contact,
        cooldown_scale=_f(
            [
                t.smac_cooldown or w.period * LOOPS_PER_SECOND
                for t, w in zip(types[:n], weapons, strict=False)
            ]
        ),
        healing_columns=np.array([t.heals for t in types[:n]]),
        enemy_heals=np.array([t.heals for t in types[n:]]),
        ally_types=_one_hot(spec.ally_type_columns, [s.unit for s in spec.allies]),
        enemy_types=_one_hot(spec.enemy_type_columns, [s.unit for s in spec.enemies]),
        mover=np.array([t.mover for t in types], np.int32),
        walkable=ground.walkable,
        walls=ground.walls.astype(np.int32),
        node=ground.node,
        ways=ground.ways,
        centre=ground.centre,
        episode_limit=np.array(spec.episode_limit, np.int32),
        reward_scale=_f(
            (REWARD_WIN + sum(REWARD_DEATH + t.health + t.shield for t in types[n:units]))
            / REWARD_SCALE
        ),
    )


def _f(values: Any) -> Any:
    return np.asarray(values, np.float32)


def _loops(seconds: list[float]) -> Any:
    return _f(np.array(seconds) * LOOPS_PER_SECOND)


def _shape(spec: MapSpec, types: list[UnitType], n: int, ground: Terrain) -> Shape:
    weapons = [t.weapon or _UNARMED for t in types]
    return Shape(
        n_allies=n,
        n_enemies=len(types) - n,
        n_types=len(spec.ally_type_columns),
        ally_shields=any(t.shield for t in types[:n]),
        enemy_shields=any(t.shield for t in types[n:]),
        n_healers=sum(t.heals for t in types),
        n_beams=sum(w.beam for w in weapons),
        ally_bursts=any(w.burst for w in weapons[:n]),
        enemy_bursts=any(w.burst for w in weapons[n:]),
        flyers=any(t.mover is Mover.AIR for t in types),
        plain=ground.plain,
        ground=ground.ways.shape[1],
        width=spec.cells.shape[0],
        height=spec.cells.shape[1],
        ally_heals=any(t.heals for t in types[:n]),
    )


def _bounds(types: list[UnitType], ground: Terrain) -> NDArray[np.float32]:
    inner = _f([t.inner_radius for t in types])
    low_x, high_x, low_y, high_y = ground.bounds[[t.mover for t in types]].T
    return np.stack([low_x + inner, high_x - inner, low_y + inner, high_y - inner])


def _strikes(attacker: UnitType, target: UnitType) -> bool:
    weapon = attacker.weapon
    return weapon is not None and (weapon.air or target.mover is not Mover.AIR)


def _hostile(i: int, j: int, n: int) -> bool:
    return (i < n) != (j < n)


def _hit(weapon: Weapon, target: UnitType) -> float:
    return weapon.damage + (weapon.bonus if weapon.bonus_against in target.attributes else 0.0)


def _damage(types: list[UnitType], n: int) -> NDArray[np.float32]:
    table = np.zeros((len(types), len(types)), np.float32)
    for i, attacker in enumerate(types):
        for j, target in enumerate(types):
            weapon = attacker.weapon
            if weapon and not weapon.burst and _hostile(i, j, n) and _strikes(attacker, target):
                table[i, j] = _hit(weapon, target)
    return table


def _bursts(types: list[UnitType], n: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    damage = np.zeros((len(types), len(types)), np.float32)
    armour = np.tile(_f([t.armour for t in types]), (len(types), 1))
    for i, attacker in enumerate(types):
        for j, target in enumerate(types):
            weapon = attacker.weapon
            if not weapon or not weapon.burst or not _hostile(i, j, n):
                continue
            if "structure" in target.attributes:
                damage[i, j], armour[i, j] = weapon.burst_on_structures, 0.0
            elif _strikes(attacker, target):
                damage[i, j] = _hit(weapon, target)
    return damage, armour


def _reach(types: list[UnitType], n: int, least: float) -> NDArray[np.float32]:
    reach = [
        [max(least, e.weapon.range if e.weapon else 0.0) + e.radius + a.radius for a in types[:n]]
        for e in types[n:]
    ]
    return np.square(_f(reach))


def _reluctance(types: list[UnitType], n: int, damage: Any) -> NDArray[np.float32]:
    table = np.zeros((len(types) - n, n), np.float32)
    for j, enemy in enumerate(types[n:]):
        for i, ally in enumerate(types[:n]):
            if not _strikes(enemy, ally):
                table[j, i] = np.inf
            elif not (ally.heals or _strikes(ally, enemy)):
                table[j, i] = 1e6
    return table


def _goals(spec: MapSpec, places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Marching enemies keep their formation: each goes to the point plus its own offset."""
    goals = places.copy()
    order, n = spec.enemy_order, len(spec.allies)
    if order.kind == "attack_move":
        point = np.array([order.x, order.y])
        goals[n:] = point + places[n:] - places[n:].mean(0)
        for k in range(n, len(goals)):
            x, y = np.floor(goals[k]).astype(int)
            inside = 0 <= x < spec.cells.shape[0] and 0 <= y < spec.cells.shape[1]
            if not inside or spec.cells[x, y] != GROUND:
                goals[k] = point
    return goals


def _spread(spec: MapSpec) -> NDArray[np.float32]:
    spread = spec.enemy_order.spread_x, spec.enemy_order.spread_y
    return _f([spread] if any(spread) else np.zeros((0, 2)))


def _contacts(types: list[UnitType]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    on_the_ground = np.full((len(types), len(types)), APART)
    in_the_air = on_the_ground.copy()
    for i, one in enumerate(types):
        for j, other in enumerate(types):
            if i != j and _collide(one, other):
                plane = in_the_air if Mover.AIR in (one.mover, other.mover) else on_the_ground
                plane[i, j] = one.separation + other.separation
    return _f(on_the_ground), _f(in_the_air)


def _collide(one: UnitType, other: UnitType) -> bool:
    movers = {one.mover, other.mover}
    if movers == {Mover.CLIFF, Mover.GROUND}:
        return "structure" in one.attributes | other.attributes
    return len(movers) == 1 or movers == {Mover.CLIFF, Mover.AIR}


def _one_hot(columns: tuple[str, ...], units: list[str]) -> NDArray[np.float32]:
    return _f([[float(unit == column) for column in columns] for unit in units]).reshape(
        len(units), len(columns)
    )
