"""The unit types: what each can do, as StarCraft II's Liberty campaign data have it.

SMAC's maps depend on that data set alone, so these are the campaign's numbers and not those of the
multiplayer game. Times are in seconds of the game's "normal" speed, lengths in cells, as in the
data. One game loop is 1/16 s.
"""

import enum
from dataclasses import dataclass
from typing import Final

LOOPS_PER_SECOND: Final = 16


GROUND: Final = "."
WALL: Final = "#"
"""A wall or a pit."""
CLIFF: Final = "C"
"""A cliff between two levels of ground."""
HALF_TILE: Final = "/"
"""A cell of a cliff tile cut diagonally that lies on the floor's side, though the map's flags block
it. Whether the game's grid, and so SMAC's mask, counts it as ground is not known."""
HALF_TILES_ARE: Final = GROUND
"""What these cells are taken for: GROUND or WALL. As walls they part corridor in three."""


class Mover(enum.IntEnum):
    """How a unit gets about."""

    GROUND = 0
    CLIFF = 1
    """On the ground, and up and down the cliffs between two walkable levels."""
    AIR = 2


@dataclass(frozen=True)
class Weapon:
    """An attack.

    Attributes:
        damage: per hit.
        bonus: added to each hit on a target that has the attribute `bonus_against`.
        period: seconds from one attack to the next, before its random delay.
        range: from edge to edge.
        damage_point: seconds the attacker stands and aims before the attack leaves it.
        backswing: seconds it stays where it is afterwards, unless it gets another order.
        slop: how much further than `range` the target may get while the attacker aims.
        hits: hits of one attack. The second of two comes `second_hit` seconds after the first.
        second_hit: 0 if both hits come together.
        delay: seconds from the attack to its hit.
        missile_speed: cells per second of a missile, which also hits once its shooter is dead;
            0 without a missile.
        air: whether it reaches flying targets.
        beam: whether both hits strike every enemy on a line across the target.
        burst: radius in which the attack strikes every enemy, and ends the attacker; 0 if not.
        burst_on_structures: what the burst does to structures, whatever their armour.
    """

    damage: float
    period: float
    range: float
    bonus: float = 0.0
    bonus_against: str | None = None
    damage_point: float = 0.167
    backswing: float = 0.5
    slop: float = 1.0
    hits: int = 1
    second_hit: float = 0.0
    delay: float = 0.0
    missile_speed: float = 0.0
    air: bool = False
    beam: bool = False
    burst: float = 0.0
    burst_on_structures: float = 0.0


@dataclass(frozen=True)
class UnitType:
    """A kind of unit.

    Attributes:
        health: at most.
        attributes: what bonus damage and healing ask for.
        radius: of its body, from which ranges are measured.
        separation: radius with which it keeps others off.
        inner_radius: how near its centre comes to a wall.
        speed: cells per second.
        letter: drawn on it in pictures.
        rank: allies are numbered by rank, then x, then y, as SMAC sorts its own copies of the
            types by their numbers.
        smac_cooldown: by what SMAC divides the cooldown (of healers the energy) in the state.
            None where SMAC has no such ally: the weapon's period in game loops.
        shield: at most; it comes back `shield_delay` seconds after the last damage.
        acceleration: cells per second squared.
        heals: whether it heals friends that are biological and no structures.
        health_regeneration: health per second.
        weapon: None if it cannot attack.
    """

    health: float
    attributes: frozenset[str]
    radius: float
    separation: float
    inner_radius: float
    speed: float
    letter: str
    rank: int
    smac_cooldown: float | None = None
    shield: float = 0.0
    armour: float = 0.0
    acceleration: float = 1000.0
    mover: Mover = Mover.GROUND
    heals: bool = False
    health_regeneration: float = 0.0
    weapon: Weapon | None = None


# Facts about every unit of a race.
SHIELD_REGENERATION: Final = 2.0
"""Shield points per second."""
SHIELD_DELAY: Final = 10.0
"""Seconds without damage before a shield comes back."""
ZERG_REGENERATION: Final = 0.2734
"""Health per second of every Zerg unit."""

# Healing.
START_ENERGY: Final = 50.0
MAX_ENERGY: Final = 200.0
ENERGY_REGENERATION: Final = 0.5625
"""Energy per second."""
HEAL_RATE: Final = 9.0
"""Health per second."""
HEAL_COST: Final = 0.33
"""Energy per point of health."""
HEAL_RANGE: Final = 4.0
"""From edge to edge."""

UNIT_TYPES: Final[dict[str, UnitType]] = {
    "Colossus": UnitType(
        health=200.0,
        shield=150.0,
        armour=1.0,
        attributes=frozenset({"armoured", "mechanical", "massive"}),
        radius=1.0,
        separation=0.75,
        inner_radius=0.5625,
        speed=2.25,
        mover=Mover.CLIFF,
        letter="C",
        rank=0,
        smac_cooldown=24.0,
        # The two sweeps of the beam meet the target 0.343 + 0.375 s after the shot.
        weapon=Weapon(
            damage=20.0,
            period=2.2,
            range=6.0,
            hits=2,
            damage_point=0.0832,
            slop=0.0,
            delay=0.343 + 0.375,
            beam=True,
        ),
    ),
    "Stalker": UnitType(
        health=80.0,
        shield=80.0,
        armour=1.0,
        attributes=frozenset({"armoured", "mechanical"}),
        radius=0.625,
        separation=0.625,
        inner_radius=0.5,
        speed=2.9531,
        letter="S",
        rank=1,
        smac_cooldown=35.0,
        weapon=Weapon(
            damage=10.0,
            bonus=4.0,
            bonus_against="armoured",
            period=1.44,
            range=6.0,
            missile_speed=18.75,
            air=True,
        ),
    ),
    "Zealot": UnitType(
        health=100.0,
        shield=50.0,
        armour=1.0,
        attributes=frozenset({"light", "biological"}),
        radius=0.5,
        separation=0.375,
        inner_radius=0.375,
        speed=2.25,
        letter="Z",
        rank=2,
        smac_cooldown=22.0,
        weapon=Weapon(damage=8.0, period=1.2, range=0.1, hits=2, second_hit=0.28, damage_point=0.0),
    ),
    "Marauder": UnitType(
        health=125.0,
        armour=1.0,
        attributes=frozenset({"armoured", "biological"}),
        radius=0.5625,
        separation=0.5,
        inner_radius=0.375,
        speed=2.25,
        letter="D",
        rank=3,
        smac_cooldown=25.0,
        weapon=Weapon(
            damage=10.0,
            bonus=10.0,
            bonus_against="armoured",
            period=1.5,
            range=6.0,
            damage_point=0.0,
            backswing=0.0,
            missile_speed=20.0,
        ),
    ),
    "Marine": UnitType(
        health=45.0,
        attributes=frozenset({"light", "biological"}),
        radius=0.375,
        separation=0.375,
        inner_radius=0.375,
        speed=2.25,
        letter="M",
        rank=4,
        smac_cooldown=15.0,
        weapon=Weapon(
            damage=6.0, period=0.8608, range=5.0, damage_point=0.05, backswing=0.75, air=True
        ),
    ),
    "Medivac": UnitType(
        health=150.0,
        armour=1.0,
        attributes=frozenset({"armoured", "mechanical"}),
        radius=0.75,
        separation=0.75,
        inner_radius=0.75,
        speed=2.75,
        acceleration=2.3125,
        mover=Mover.AIR,
        heals=True,
        letter="V",
        rank=5,
        smac_cooldown=MAX_ENERGY,
    ),
    "Baneling": UnitType(
        health=30.0,
        attributes=frozenset({"biological"}),
        radius=0.375,
        separation=0.375,
        inner_radius=0.375,
        speed=2.5,
        health_regeneration=ZERG_REGENERATION,
        letter="b",
        rank=6,
        smac_cooldown=1.0,
        weapon=Weapon(
            damage=20.0,
            bonus=15.0,
            bonus_against="light",
            period=0.833,
            range=0.25,
            damage_point=0.0,
            burst=2.2,
            burst_on_structures=80.0,
        ),
    ),
    "Zergling": UnitType(
        health=35.0,
        attributes=frozenset({"light", "biological"}),
        radius=0.375,
        separation=0.375,
        inner_radius=0.375,
        speed=2.9531,
        health_regeneration=ZERG_REGENERATION,
        letter="z",
        rank=7,
        smac_cooldown=11.0,
        weapon=Weapon(damage=5.0, period=0.696, range=0.1),
    ),
    "Hydralisk": UnitType(
        health=80.0,
        attributes=frozenset({"light", "biological"}),
        radius=0.625,
        separation=0.5,
        inner_radius=0.375,
        speed=2.25,
        health_regeneration=ZERG_REGENERATION,
        letter="H",
        rank=8,
        smac_cooldown=10.0,
        # Within 0.5 it strikes with its claws: the same damage 0.09 s later, left out here.
        weapon=Weapon(
            damage=12.0, period=0.83, range=5.0, damage_point=0.208, missile_speed=40.0, air=True
        ),
    ),
    "SpineCrawler": UnitType(
        health=300.0,
        armour=2.0,
        attributes=frozenset({"armoured", "biological", "structure"}),
        radius=0.875,
        separation=0.875,
        inner_radius=0.875,
        speed=0.0,
        health_regeneration=ZERG_REGENERATION,
        letter="#",
        rank=9,
        # How long its tentacle takes is not documented; 0.2 to 0.4 s are plausible.
        weapon=Weapon(
            damage=25.0,
            bonus=5.0,
            bonus_against="armoured",
            period=1.6,
            range=7.0,
            damage_point=0.3332,
            slop=0.0,
            delay=0.3,
        ),
    ),
}
"""All unit types by name."""
