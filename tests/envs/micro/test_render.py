"""Recordings of battles and their pictures."""

import functools
import math
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chosen import MAPS

from race.cli.render import PolicyName
from race.envs.micro import Battle, make, smac
from race.envs.micro.battle import LOOPS_PER_STEP, NORTH
from race.envs.micro.canvas import WHITE, Canvas, Window
from race.envs.micro.policies import POLICIES
from race.envs.micro.recording import Recording, play, step_and_film, verdict_of
from race.envs.micro.render import Painter, frames, n_frames, used, whole
from race.envs.micro.smac import Info
from race.envs.micro.state import Units
from race.envs.micro.units import UNIT_TYPES, WALL, Mover

step = jax.jit(smac.step)
filmed = jax.jit(step_and_film)


@functools.cache
def recorded(policy: str, seed: int, most_steps: int | None) -> tuple[Battle, Recording]:
    battle = make("3s_vs_3z")
    return battle, play(battle, POLICIES[policy], seed, most_steps)


def start(battle: Battle) -> Units:
    env_state, _ = battle.reset(jax.random.key(0))
    return Units(*(np.array(leaf) for leaf in env_state.units))


def painted(battle: Battle, *moments: Units) -> np.ndarray:
    painter = Painter(battle, whole(battle))
    for units in moments:
        painter.see(units)
    return np.asarray(painter.draw(0, 0.0)).astype(int)


def changed(units: Units, k: int, **values: float) -> Units:
    """The units with some values of one of them changed."""
    copies = {name: getattr(units, name).copy() for name in values}
    for name, value in values.items():
        copies[name][k] = value
    return units._replace(**copies)


def differs(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.abs(one - other).max(axis=2) > 12


def around(battle: Battle, x: float, y: float, radius: float) -> np.ndarray:
    """Pixels of a frame of the whole map within a radius of a place, as a mask."""
    window = whole(battle)
    size = Canvas(battle.spec, window).size
    scale = size[0] / (window.right - window.left)
    top = size[1] - (window.top - window.bottom) * scale  # the caption is above the ground
    rows, columns = np.indices((size[1], size[0]))
    away_x = (columns + 0.5) / scale + window.left - x
    away_y = window.top - (rows + 0.5 - top) / scale - y
    return np.hypot(away_x, away_y) <= radius


# ---------------------------------------------------------------- recordings


@pytest.mark.parametrize("name", ["3s_vs_3z", "MMM"])
def test_films_end_where_steps_end(name: str) -> None:
    battle = make(name)
    key = jax.random.key(1)
    env_state, _ = battle.reset(key)
    n = battle.shape.n_allies
    refused = 0
    close = functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-4)
    for tick in range(9):
        key, now, lot = jax.random.split(key, 3)
        # Some walk, some name an enemy out of reach, some want to be dead.
        actions = jax.random.randint(lot, (n,), 0, battle.shape.n_actions)
        expected, timestep = step(battle.scenario, env_state, actions, now)
        after, seen, film = filmed(battle.scenario, env_state, actions, now)
        refused += int(timestep.info.refused.sum())
        jax.tree.map(close, expected, after)
        jax.tree.map(close, timestep, seen)
        assert film.x.shape == (LOOPS_PER_STEP, n + battle.shape.n_enemies)
        jax.tree.map(lambda shots, end: close(shots[-1], end), film, expected.units)
        moved = np.hypot(film.x[0] - env_state.units.x, film.y[0] - env_state.units.y)
        assert (moved <= battle.scenario.speed + 0.25 + 1e-4).all(), tick  # one loop, and a push
        env_state = expected
    assert refused > 3


def test_films_of_battles_that_are_over_stand_still() -> None:
    battle = make("3s_vs_3z")
    env_state, _ = battle.reset(jax.random.key(0))
    env_state = env_state._replace(over=jnp.array(True))
    actions = jnp.full(battle.shape.n_allies, NORTH)
    after, _, film = filmed(battle.scenario, env_state, actions, jax.random.key(1))
    jax.tree.map(
        lambda shots, still: np.testing.assert_array_equal(
            shots, np.broadcast_to(still, shots.shape)
        ),
        film,
        after.units,
    )


def test_seeds_decide_recordings_and_the_length_does_not() -> None:
    battle, long = recorded("random", 3, 6)
    assert len(long.units.x) == 6 * LOOPS_PER_STEP + 1
    assert len(long.returns) == 6
    assert long.verdict == ""
    again = play(battle, POLICIES["random"], 3, 6)
    jax.tree.map(np.testing.assert_array_equal, long, again)
    short = play(battle, POLICIES["random"], 3, 2)
    jax.tree.map(
        lambda one, other: np.testing.assert_array_equal(one[: len(other)], other),
        (long.units, long.returns),
        (short.units, short.returns),
    )
    other = play(battle, POLICIES["random"], 4, 6)
    assert not np.array_equal(long.units.x, other.units.x)


def test_recordings_end_with_the_battle() -> None:
    battle, recording = recorded("scripted", 0, None)
    steps = len(recording.returns)
    assert len(recording.units.x) == steps * LOOPS_PER_STEP + 1
    n = battle.shape.n_allies
    alive = recording.units.health[-1] > 0
    expected = {(True, False): "won", (False, True): "lost", (False, False): "draw"}
    sides = bool(alive[:n].any()), bool(alive[n:].any())
    assert recording.verdict == expected.get(sides, "time")
    assert (steps == battle.spec.episode_limit) == (sides == (True, True))
    # The battle had not ended a step earlier.
    before = recording.units.health[-1 - LOOPS_PER_STEP] > 0
    assert before[:n].any()
    assert before[n:].any()
    assert (np.diff(recording.returns) >= 0).all()


@pytest.mark.parametrize(
    ("won", "allies", "enemies", "timed_out", "verdict"),
    [
        (True, 1, 3, False, "won"),
        (False, 3, 1, False, "lost"),
        (False, 3, 3, False, "draw"),
        (False, 1, 1, True, "time"),
    ],
)
def test_verdicts(won: bool, allies: int, enemies: int, timed_out: bool, verdict: str) -> None:
    info = Info(*map(np.array, (won, allies, enemies, timed_out, np.zeros(3, bool))))
    assert verdict_of(make("3s_vs_3z").scenario, info) == verdict


# ---------------------------------------------------------------- films


def test_frames_are_all_there_and_hold_the_end() -> None:
    battle, recording = recorded("scripted", 0, None)
    # The last two steps are enough to see.
    units = jax.tree.map(lambda leaf: leaf[-2 * LOOPS_PER_STEP - 1 :], recording.units)
    ending = Recording(units, recording.returns[-2:], recording.verdict)
    drawn = list(frames(battle, ending))
    moments = 2 * LOOPS_PER_STEP + 1
    assert len(drawn) == n_frames(ending) > moments
    assert {(frame.dtype, frame.shape) for frame in drawn} == {(np.dtype(np.uint8), drawn[0].shape)}
    assert not any(pixels % 2 for pixels in drawn[0].shape[:2])  # as H.264 wants it
    assert all(np.array_equal(frame, drawn[-1]) for frame in drawn[moments:])
    # Cut before the end there is nothing to hold; the pictures are the same but for the verdict.
    cut = list(frames(battle, ending._replace(verdict="")))
    assert len(cut) == n_frames(ending._replace(verdict="")) == moments
    for one, other in zip(drawn[: moments - 1], cut[:-1], strict=True):
        np.testing.assert_array_equal(one, other)
    assert not np.array_equal(drawn[moments - 1], cut[-1])


def test_everyone_stays_in_the_picture() -> None:
    battle, recording = recorded("random", 3, 6)
    window = used(battle.spec, recording.units)
    radius = np.asarray(battle.scenario.radius)
    x, y = recording.units.x, recording.units.y
    assert (x - radius >= window.left).all()
    assert (x + radius <= window.right).all()
    assert (y - radius >= window.bottom).all()
    assert (y + radius <= window.top).all()
    # Where the dead lie does not matter.
    far = recording.units._replace(x=x.copy(), health=recording.units.health.copy())
    far.x[:, 0], far.health[:, 0] = 31.0, 0.0
    assert used(battle.spec, far).right <= window.right


@pytest.mark.parametrize("name", MAPS)
def test_every_unit_of_every_map_is_drawn_where_it_is(name: str) -> None:
    battle = make(name)
    window = whole(battle)
    cells = battle.spec.cells
    x, y = np.nonzero(cells != WALL)
    assert window.left <= x.min() < x.max() + 1 <= window.right
    assert window.bottom <= y.min() < y.max() + 1 <= window.top
    units = start(battle)
    everyone = painted(battle, units)
    nobody = painted(battle, units._replace(health=np.zeros_like(units.health)))
    ink = differs(everyone, nobody)
    kinds = [UNIT_TYPES[s.unit] for s in (*battle.spec.allies, *battle.spec.enemies)]
    places = np.zeros_like(ink)
    for k, kind in enumerate(kinds):
        disc = around(battle, float(units.x[k]), float(units.y[k]), 0.8 * kind.radius)
        assert ink[disc].mean() > 0.95, k
        # Bodies with their bars, and the shadows of those that fly.
        reach = 3 * kind.radius if kind.mover is Mover.AIR else kind.radius + 0.75
        places |= around(battle, float(units.x[k]), float(units.y[k]), reach)
    caption = np.zeros_like(ink)
    caption[:26] = True  # counts the living
    assert not ink[~places & ~caption].any()


@pytest.mark.parametrize("k", [0, 4])
def test_the_dead_are_not_drawn_and_their_traces_fade(k: int) -> None:
    battle = make("3s_vs_3z")
    units = start(battle)
    dead = changed(units, k, health=0.0)
    place = around(battle, float(units.x[k]), float(units.y[k]), 0.3)
    empty = painted(battle, units._replace(health=np.zeros_like(units.health)))
    assert differs(painted(battle, units), empty)[place].mean() > 0.95
    assert not differs(painted(battle, dead), empty)[place].any()
    traces = [
        differs(painted(battle, units, *[dead] * loops), empty)[place].mean() for loops in (1, 99)
    ]
    assert 0.1 < traces[0] < 0.9
    assert traces[1] == 0.0


def colourful(frame: np.ndarray, place: np.ndarray, *, blue: bool) -> int:
    red, green, other = (frame[..., k] for k in range(3))
    if blue:
        bar = (other > 220) & (green > 160) & (red < 150)  # shields
    else:
        bar = (np.maximum(red, green) > 190) & (green > 100) & (other < 110)  # green to orange
    return int((bar & place).sum())


@pytest.mark.parametrize("name", ["MMM", "3s_vs_3z"])
def test_bars_are_as_long_as_what_they_show(name: str) -> None:
    battle = make(name)
    units, kind = start(battle), UNIT_TYPES[battle.spec.allies[0].unit]
    # One agent where no one hides its bars.
    alone = units._replace(health=np.zeros_like(units.health))
    alone = changed(alone, 0, x=16.0, y=20.0, health=kind.health)
    above = around(battle, 16.0, 20.0 + kind.radius + 0.2, kind.radius + 0.2)
    above &= ~around(battle, 16.0, 20.0, kind.radius)
    shares = (1.0, 0.75, 0.5, 0.25)
    lengths = [
        colourful(painted(battle, changed(alone, 0, health=s * kind.health)), above, blue=False)
        for s in shares
    ]
    assert lengths == sorted(set(lengths), reverse=True)
    np.testing.assert_allclose(np.array(lengths) / lengths[0], shares, atol=0.12)
    if kind.shield:
        shields = [
            colourful(painted(battle, changed(alone, 0, shield=s * kind.shield)), above, blue=True)
            for s in shares
        ]
        np.testing.assert_allclose(np.array(shields) / shields[0], shares, atol=0.12)


def test_unhurt_units_of_a_swarm_show_no_bars() -> None:
    battle = make("so_many_baneling")
    units, k = start(battle), 20
    alone = units._replace(health=np.zeros_like(units.health))
    above = around(battle, float(units.x[k]), float(units.y[k]) + 0.5, 0.3)
    whole_one = painted(battle, changed(alone, k, health=30.0))
    hurt_one = painted(battle, changed(alone, k, health=20.0))
    assert colourful(whole_one, above, blue=False) == 0 < colourful(hurt_one, above, blue=False)


# ---------------------------------------------------------------- attacks


def centre_of(ink: np.ndarray) -> np.ndarray:
    return np.argwhere(ink).mean(axis=0)


def test_aims_are_lines_to_the_target() -> None:
    battle = make("3s_vs_3z")
    units = start(battle)
    middle = around(battle, 16.0, 16.0, 1.5)
    quiet = painted(battle, units)
    aiming = changed(units, 0, aiming=1.0, target=3)
    assert differs(painted(battle, aiming), quiet)[middle].any()
    # A dead target, a dead attacker, or no aim: no line.
    for wrong in (
        changed(aiming, 3, health=0.0),
        changed(aiming, 0, health=0.0),
        changed(aiming, 0, aiming=0.0),
    ):
        assert not differs(painted(battle, wrong), quiet)[middle].any()


def test_missiles_fly_to_their_target_even_when_the_shooter_is_dead() -> None:
    battle = make("3s_vs_3z")
    units = changed(start(battle), 0, struck=3, cooldown=20.0, health=0.0)
    quiet = painted(battle, units)
    columns = []
    for pending in (6.0, 4.0, 2.0):
        ink = differs(painted(battle, changed(units, 0, pending=pending)), quiet)
        columns.append(centre_of(ink)[1])
    assert columns == sorted(columns)
    # The Stalkers' missiles fly 18.75 cells a second, 1.17 a loop.
    window = whole(battle)
    scale = quiet.shape[1] / (window.right - window.left)
    np.testing.assert_allclose(np.diff(columns) / scale, 2 * 18.75 / 16, rtol=0.1)


def test_bursts_cover_what_they_strike_and_fade() -> None:
    battle = make("so_many_baneling")
    units, k = start(battle), 20
    alone = units._replace(health=np.zeros_like(units.health))
    before, after = changed(alone, k, health=30.0), alone
    x, y = float(units.x[k]), float(units.y[k])
    ring = around(battle, x, y, 2.0) & ~around(battle, x, y, 1.2)
    beyond = ~around(battle, x, y, 2.4)
    beyond[:26] = False
    quiet = painted(battle, after)
    burst = differs(painted(battle, before, after), quiet)
    assert burst[ring].mean() > 0.95
    assert not burst[beyond].any()
    faded = differs(painted(battle, before, *[after] * 99), quiet)
    assert not faded[26:].any()


def test_beams_lie_across_the_shot() -> None:
    battle = make("2c_vs_64zg")
    units = start(battle)
    alone = units._replace(health=np.zeros_like(units.health))
    alone = changed(alone, 0, health=200.0, struck=5)
    alone.beam[0] = (20.0, 20.0, 0.6, 0.8)  # the middle, and the direction of the shot
    quiet = painted(battle, alone)
    # Near the end of the shot the rays are gone and the line is left.
    ink = differs(painted(battle, changed(alone, 0, pending=3.0)), quiet)
    rows, columns = np.nonzero(ink)
    spread = np.linalg.svd(np.stack([columns, -rows], 1) - centre_of(ink)[::-1] * [1, -1])[2][0]
    assert abs(spread @ np.array([0.6, 0.8])) < 0.05
    window = whole(battle)
    scale = quiet.shape[1] / (window.right - window.left)
    length = np.ptp(np.stack([columns, -rows], 1) @ spread) / scale
    assert math.isclose(length, 2.5, abs_tol=0.4)
    assert not differs(painted(battle, changed(alone, 0, pending=0.0)), quiet).any()


def test_healing_is_a_line_while_energy_is_spent() -> None:
    battle = make("MMM")
    units = start(battle)
    healer = battle.shape.n_allies - 1
    alone = units._replace(health=np.where(np.arange(len(units.x)) == healer, 150.0, 0.0))
    alone = changed(changed(alone, 0, health=20.0, x=20.0), healer, target=0, x=16.0)
    between = around(battle, 18.0, 16.0, 0.8)
    quiet = painted(battle, alone)
    spent = painted(battle, alone, changed(alone, healer, energy=49.0))
    gained = painted(battle, alone, changed(alone, healer, energy=51.0))
    assert differs(spent, quiet)[between].any()
    assert not differs(gained, quiet)[between].any()


def test_the_caption_tells_how_it_ended() -> None:
    battle = make("3s_vs_3z")
    painter = Painter(battle, whole(battle))
    painter.see(start(battle))
    pictures = [painter.draw(3, 1.5, verdict) for verdict in ("", "won", "lost", "time", "draw")]
    for one, picture in enumerate(pictures):
        np.testing.assert_array_equal(picture[26:], pictures[0][26:])
        for other in pictures[:one]:
            assert not np.array_equal(picture, other)


def test_pens_draw_in_cells() -> None:
    spec = make("3s_vs_3z").spec
    canvas = Canvas(spec, Window(2.0, 4.0, 12.0, 10.0))
    pen = canvas.begin()
    pen.disc((7.0, 9.0), 0.5, WHITE)
    picture = pen.finish([], [])
    bright = (picture > 250).all(axis=2)
    bright[:26] = False
    scale = canvas.size[0] / 10.0
    row, column = centre_of(bright)
    assert math.isclose(column / scale + 2.0, 7.0, abs_tol=0.05)
    assert math.isclose(10.0 - (row - 26) / scale, 9.0, abs_tol=0.05)
    assert math.isclose(bright.sum() / scale**2, math.pi / 4, rel_tol=0.1)


def test_policies_are_those_of_the_command_line() -> None:
    assert set(get_args(PolicyName)) == set(POLICIES)
