"""Recordings of battles and their pictures."""

import dataclasses
import functools
import math
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chosen import MAPS

from race.cli.render import PolicyName
from race.envs.micro import Battle, colors, ground, load_map, make, map_names, smac, state
from race.envs.micro.battle import LOOPS_PER_STEP, NORTH
from race.envs.micro.canvas import LARGE, SMALL, Pen, View, Window, fit, line, stamp
from race.envs.micro.legend import Legend, Standing, is_short
from race.envs.micro.policies import POLICIES
from race.envs.micro.recording import Recording, play, step_and_film, verdict_of
from race.envs.micro.render import Painter, frames, n_frames, used, whole
from race.envs.micro.smac import Info
from race.envs.micro.sprites import body, disc, faded, over
from race.envs.micro.state import Units
from race.envs.micro.units import CLIFF, GROUND, HALF_TILE, UNIT_TYPES, WALL, Mover

step = jax.jit(smac.step)
filmed = jax.jit(step_and_film)


@functools.cache
def recorded(policy: str, seed: int, most_steps: int | None) -> tuple[Battle, Recording]:
    battle = make("3s_vs_3z")
    return battle, play(battle, POLICIES[policy], seed, most_steps)


def start(battle: Battle) -> Units:
    env_state = state.start(battle.scenario)  # compiles nothing
    return Units(*(np.array(leaf) for leaf in env_state.units))


@functools.cache
def painter_of(name: str) -> Painter:
    battle = make(name)
    return Painter(battle, whole(battle), SMALL)


def painted(battle: Battle, *moments: Units) -> np.ndarray:
    painter = painter_of(battle.spec.name)
    painter.forget()
    for units in moments:
        painter.see(units)
    return np.asarray(painter.draw(0, 0.0)).astype(int)


def changed(units: Units, k: int, **values: float) -> Units:
    """The units with some values of one of them changed."""
    copies = {name: getattr(units, name).copy() for name in values}
    for name, value in values.items():
        copies[name][k] = value
    return units._replace(**copies)


def nobody(units: Units) -> Units:
    return units._replace(health=np.zeros_like(units.health))


def differs(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.abs(one - other).max(axis=2) > 12


@functools.cache
def places(view: View) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each pixel of a frame its x and y in the map, and whether it shows the battle."""
    rows, columns = np.indices(view.size[::-1])
    left, top, right, bottom = view.box
    x = view.window.left + (columns + 0.5 - left) / view.scale
    y = view.window.top - (rows + 0.5 - top) / view.scale
    return x, y, (columns >= left) & (columns < right) & (rows >= top) & (rows < bottom)


def around(battle: Battle, x: float, y: float, radius: float) -> np.ndarray:
    """Pixels of a frame of the whole map within a radius of a place, as a mask."""
    view = painter_of(battle.spec.name).view
    across, up, shown = places(view)
    mask = np.zeros_like(shown)
    column = view.box.left + (x - view.window.left) * view.scale
    row = view.box.top + (view.window.top - y) * view.scale
    reach = radius * view.scale + 1
    near = tuple(
        slice(max(math.floor(middle - reach), 0), max(math.ceil(middle + reach), 0))
        for middle in (row, column)
    )
    mask[near] = shown[near] & (np.hypot(across[near] - x, up[near] - y) <= radius)
    return mask


# ---------------------------------------------------------------- recordings


@pytest.mark.parametrize("name", ["3s_vs_3z", pytest.param("MMM", marks=pytest.mark.slow)])
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
    actions = jnp.full(battle.shape.n_allies, NORTH, jnp.int32)
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
    drawn = list(frames(battle, ending, SMALL))
    moments = 2 * LOOPS_PER_STEP + 1
    assert len(drawn) == n_frames(ending) > moments
    assert {(frame.dtype, frame.shape) for frame in drawn} == {(np.dtype(np.uint8), (540, 960, 3))}
    assert all(np.array_equal(frame, drawn[-1]) for frame in drawn[moments:])
    # Cut before the end there is nothing to hold; the pictures are the same but for the verdict.
    cut = list(frames(battle, ending._replace(verdict=""), SMALL))
    assert len(cut) == n_frames(ending._replace(verdict="")) == moments
    for one, other in zip(drawn[: moments - 1], cut[:-1], strict=True):
        np.testing.assert_array_equal(one, other)
    assert not np.array_equal(drawn[moments - 1], cut[-1])


def test_frames_are_large_unless_told_otherwise() -> None:
    battle, recording = recorded("random", 3, 6)
    frame = next(frames(battle, recording))
    assert frame.shape == (1080, 1920, 3)
    assert (LARGE, SMALL) == ((1920, 1080), (960, 540))


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


@pytest.mark.parametrize("size", [LARGE, SMALL])
@pytest.mark.parametrize(
    "shown",
    [
        Window(0.0, 0.0, 32.0, 32.0),
        Window(0.0, 8.0, 32.0, 24.0),
        Window(14.0, 2.0, 15.0, 30.0),
        Window(30.0, 30.0, 32.0, 32.0),
        Window(3.5, 4.25, 20.0, 16.0),
    ],
)
def test_views_fill_the_frame_and_show_what_they_must(shown: Window, size: tuple[int, int]) -> None:
    box, window, scale, legend = (
        getattr(fit(shown, (32, 32), size), name) for name in ("box", "window", "scale", "legend")
    )
    # Battle and legend are the frame, side by side.
    areas = [(b.right - b.left) * (b.bottom - b.top) for b in (box, legend)]
    assert sum(areas) == size[0] * size[1]
    assert areas[0] > 0.8 * sum(areas)
    assert (box.right, box.bottom) == size
    assert math.isclose((window.right - window.left) * scale, box.right - box.left)
    assert math.isclose((window.top - window.bottom) * scale, box.bottom - box.top)
    assert window.left <= shown.left < shown.right <= window.right + 1e-9
    assert window.bottom <= shown.bottom < shown.top <= window.top + 1e-9
    # What is beyond the map is only shown if all of the map is.
    if window.right - window.left <= 32:
        assert 0 <= window.left < window.right <= 32 + 1e-9
    if window.top - window.bottom <= 32:
        assert 0 <= window.bottom < window.top <= 32 + 1e-9


@pytest.mark.parametrize("name", MAPS)
def test_every_unit_of_every_map_is_drawn_where_it_is(name: str) -> None:
    battle = make(name)
    units = start(battle)
    ink = differs(painted(battle, units), painted(battle, nobody(units)))
    kinds = [UNIT_TYPES[s.unit] for s in (*battle.spec.allies, *battle.spec.enemies)]
    covered = np.zeros_like(ink)
    for k, kind in enumerate(kinds):
        place = float(units.x[k]), float(units.y[k])
        assert ink[around(battle, *place, 0.9 * kind.radius)].mean() > 0.95, k
        # Bodies, and the shadows of those that fly.
        reach = 3 * kind.radius if kind.mover is Mover.AIR else kind.radius + 0.1
        covered |= around(battle, *place, reach)
    _, _, shown = places(painter_of(battle.spec.name).view)
    assert not ink[shown & ~covered].any()


@pytest.mark.parametrize("k", [0, 4])
def test_the_dead_are_not_drawn_and_their_traces_fade(k: int) -> None:
    battle = make("3s_vs_3z")
    units = start(battle)
    dead = changed(units, k, health=0.0)
    place = around(battle, float(units.x[k]), float(units.y[k]), 0.3)
    empty = painted(battle, nobody(units))
    assert differs(painted(battle, units), empty)[place].mean() > 0.95
    assert not differs(painted(battle, dead), empty)[place].any()
    traces = [
        differs(painted(battle, units, *[dead] * loops), empty)[place].mean() for loops in (1, 99)
    ]
    assert 0.1 < traces[0] < 0.9
    assert traces[1] == 0.0


# ---------------------------------------------------------------- bodies


def near(frame: np.ndarray, color: tuple[int, int, int], by: int = 40) -> np.ndarray:
    return np.abs(frame.astype(int) - np.array(color)).max(axis=2) < by


@pytest.mark.parametrize(
    ("name", "k", "what", "color"),
    [
        ("MMM", 0, "health", None),
        ("MMM", 9, "energy", colors.ENERGY),
        ("3s_vs_3z", 0, "health", None),
        ("3s_vs_3z", 4, "shield", colors.SHIELD),
        ("27m_vs_30m", 55, "health", None),
    ],
)
def test_rings_are_as_long_as_what_they_show(
    name: str, k: int, what: str, color: tuple[int, int, int] | None
) -> None:
    battle = make(name)
    units = start(battle)
    kind = UNIT_TYPES[(*battle.spec.allies, *battle.spec.enemies)[k].unit]
    most = {"health": kind.health, "shield": kind.shield, "energy": 200.0}[what]
    alone = changed(nobody(units), k, x=16.0, y=18.0, health=kind.health, shield=0.0, energy=0.0)
    painter = Painter(battle, Window(8.0, 14.0, 24.0, 22.0), SMALL)
    x, y, _ = places(painter.view)
    place = np.hypot(x - 16.0, y - 18.0) <= kind.radius
    corner = place & (x > 16.15) & (y > 18.15)
    others = place & ((x < 15.85) | (y < 17.85))
    lengths = []
    for share in (1.0, 0.75, 0.5, 0.25):
        painter.forget()
        painter.see(changed(alone, k, **{what: share * most}))
        drawn = near(np.asarray(painter.draw(0, 0.0)), color or colors.of_health(share)) & place
        lengths.append(int(drawn.sum()))
        # Clockwise from the top: the upper right quarter is there to the last.
        assert drawn[corner].sum() > 0
        assert (drawn[others].sum() > 0) == (share > 0.25)
    assert lengths[0] > 20
    np.testing.assert_allclose(np.array(lengths) / lengths[0], (1.0, 0.75, 0.5, 0.25), atol=0.08)


def test_a_hit_flashes() -> None:
    battle = make("27m_vs_30m")
    units = start(battle)
    hurt = changed(units, 0, health=40.0)
    place = around(battle, float(units.x[0]), float(units.y[0]), 0.2)
    light = [painted(battle, units, *[hurt] * loops)[place].mean() for loops in (1, 2, 9)]
    assert light[0] > light[1] + 5 > light[2] + 10
    np.testing.assert_array_equal(
        painted(battle, units, *[hurt] * 9)[place], painted(battle, units)[place]
    )


@pytest.mark.parametrize("name", map_names())
def test_sides_and_types_have_colours_of_their_own(name: str) -> None:
    spec = load_map(name)
    allies = [colors.of_type(unit, ally=True) for unit in {s.unit for s in spec.allies}]
    enemies = [colors.of_type(unit, ally=False) for unit in {s.unit for s in spec.enemies}]
    assert all(blue > red for red, _, blue in allies)
    assert all(red > blue for red, _, blue in enemies)
    every = np.array([*allies, *enemies])
    apart = np.abs(every[:, None] - every[None]).max(axis=-1)
    assert (apart + 999 * np.eye(len(every)) > 40).all()


def test_health_goes_from_green_to_red() -> None:
    red, green, _ = zip(*(colors.of_health(share) for share in (0.05, 0.5, 1.0)), strict=True)
    assert red[0] > 2 * green[0]
    assert green[2] > 2 * red[2]
    assert min(red[1], green[1]) > 190


# ---------------------------------------------------------------- ground and legend


def test_high_ground_is_lighter_and_pits_are_dark() -> None:
    battle = make("2c_vs_64zg")
    frame = painted(battle, nobody(start(battle)))

    def light(x: float, y: float) -> float:
        return float(frame[around(battle, x, y, 0.3)].mean())

    pit, low, ramp, high = light(1.5, 7.0), light(12.5, 8.5), light(5.5, 15.5), light(12.5, 16.5)
    assert pit + 20 < low < low + 8 < ramp < ramp + 8 < high
    cliff = frame[around(battle, 12.5, 13.0, 0.8)].mean(axis=0)
    assert cliff[0] > cliff[2] + 15


def test_half_tiles_are_marked_and_ground_out_of_reach_is_dim() -> None:
    corridor = make("corridor")
    frame = painted(corridor, nobody(start(corridor)))
    rows = corridor.spec.rows
    tiles = [
        (x, len(rows) - 1 - row)
        for row, cells in enumerate(rows)
        for x, cell in enumerate(cells)
        if cell == HALF_TILE
    ]
    plain = frame[around(corridor, 20.5, 20.5, 0.35)].mean()
    for x, y in tiles:
        assert frame[around(corridor, x + 0.5, y + 0.5, 0.1)].mean() < 0.9 * plain
        assert frame[around(corridor, x + 0.5, y + 0.5, 0.4)].mean() > 0.7 * plain
    room = load_map("6h_vs_8z")
    reached = ground.reachable(room)
    assert reached.sum() == ((room.cells == GROUND) & reached).sum() < 300
    view = fit(Window(0.0, 0.0, 32.0, 32.0), (32, 32), SMALL)
    picture, (x, y, shown) = ground.paint(room, view), places(view)
    left, top, right, bottom = view.box

    def light(at_x: float, at_y: float) -> float:
        spot = shown & (np.hypot(x - at_x, y - at_y) < 0.3)
        return float(picture[spot[top:bottom, left:right]].mean())

    inside, pit, outside = light(16.5, 16.5), light(7.0, 16.5), light(3.5, 16.5)
    assert pit + 4 < outside < 0.7 * inside


@pytest.mark.parametrize("name", MAPS)
def test_floor_is_drawn_where_floor_is(name: str) -> None:
    battle = make(name)
    frame = painted(battle, nobody(start(battle)))
    reached = ground.reachable(battle.spec)
    floor = [frame[around(battle, x + 0.5, y + 0.5, 0.2)] for x, y in np.argwhere(reached)[::7]]
    assert min(cell.mean() for cell in floor) > 40
    assert (battle.spec.cells[reached] != WALL).all()
    assert {GROUND, CLIFF} >= set(battle.spec.cells[reached])


@pytest.mark.parametrize("name", MAPS)
def test_the_legend_fits_and_counts_the_living(name: str) -> None:
    battle = make(name)
    units = start(battle)
    full, left, top, right, bottom = painted(battle, units), *painter_of(name).view.legend
    strip = full[top:bottom, left:right]
    back = strip[0, 0]
    # Nothing runs into the rim, nor, in a bar, into the enemies' half.
    assert (strip[:, -3:] == back).all()
    assert (strip[-2:] == back).all()
    if not left and right > bottom:
        middle = (right - left) // 2
        assert (strip[len(strip) // 2 :, middle - 6 : middle] == back).all()
    one_less = painted(battle, changed(units, battle.shape.n_units - 1, health=0.0))
    assert differs(one_less, full)[top:bottom, left:right].any()


def test_long_names_and_many_types_fit_into_a_legend() -> None:
    spec = load_map("MMM")
    assert is_short(spec)
    groups = tuple(spec.ally_groups[0]._replace(unit=unit, size=1) for unit in UNIT_TYPES)
    many = dataclasses.replace(spec, ally_groups=groups, enemy_groups=groups)
    assert not is_short(many)
    shown = Window(0.0, 8.0, 32.0, 24.0)
    for crowd, short in ((spec, True), (many, False)):
        view = fit(shown, (32, 32), SMALL, short_legend=short)
        left, top, right, bottom = view.legend
        assert (right > bottom) == short
        legend = Legend(dataclasses.replace(crowd, name="M" * 60), view)
        frame = np.zeros((540, 960, 3), np.uint8)
        legend.paint(frame)
        alive = np.ones(len(crowd.allies) + len(crowd.enemies), np.bool_)
        legend.write(frame, Standing(8, 3.0, "won", alive))
        strip, back = frame[top:bottom, left:right], frame[0, 0]
        assert (strip[:, -3:] == back).all()
        assert (strip[-2:] == back).all()
        frame[top:bottom, left:right] = 0
        assert not frame.any()  # nothing beside the strip
        if not short:
            # A free line between what counts units and what explains rings.
            line = bottom / (12 + 2 * len(UNIT_TYPES))
            rows = (strip != back).any(axis=(1, 2))
            ends = round(bottom - 3.5 * line)
            assert not rows[ends - round(0.4 * line) : ends].any()


def test_the_legend_tells_how_it_ended() -> None:
    battle = make("3s_vs_3z")
    painter = painter_of("3s_vs_3z")
    painter.forget()
    painter.see(start(battle))
    pictures = [painter.draw(24, 1.5, verdict) for verdict in ("", "won", "lost", "time", "draw")]
    _, _, shown = places(painter_of(battle.spec.name).view)
    for one, picture in enumerate(pictures):
        np.testing.assert_array_equal(picture[shown], pictures[0][shown])
        for other in pictures[:one]:
            assert not np.array_equal(picture, other)


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
    scale = painter_of(battle.spec.name).view.scale
    np.testing.assert_allclose(np.diff(columns) / scale, 2 * 18.75 / 16, rtol=0.1)


def test_bursts_cover_what_they_strike_and_fade() -> None:
    battle = make("so_many_baneling")
    units, k = start(battle), 20
    alone = nobody(units)
    before, after = changed(alone, k, health=30.0), alone
    x, y = float(units.x[k]), float(units.y[k])
    ring = around(battle, x, y, 2.0) & ~around(battle, x, y, 1.2)
    _, _, shown = places(painter_of(battle.spec.name).view)
    beyond = shown & ~around(battle, x, y, 2.4)
    quiet = painted(battle, after)
    burst = differs(painted(battle, before, after), quiet)
    assert burst[ring].mean() > 0.95
    assert not burst[beyond].any()
    faded = differs(painted(battle, before, *[after] * 99), quiet)
    assert not faded[shown].any()


def test_beams_lie_across_the_shot() -> None:
    battle = make("2c_vs_64zg")
    units = start(battle)
    alone = nobody(units)
    alone = changed(alone, 0, health=200.0, struck=5)
    alone.beam[0] = (20.0, 20.0, 0.6, 0.8)  # the middle, and the direction of the shot
    quiet = painted(battle, alone)
    # Near the end of the shot the rays are gone and the line is left.
    ink = differs(painted(battle, changed(alone, 0, pending=3.0)), quiet)
    rows, columns = np.nonzero(ink)
    spread = np.linalg.svd(np.stack([columns, -rows], 1) - centre_of(ink)[::-1] * [1, -1])[2][0]
    assert abs(spread @ np.array([0.6, 0.8])) < 0.05
    scale = painter_of(battle.spec.name).view.scale
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


# ---------------------------------------------------------------- pens and sprites


@pytest.mark.parametrize(
    ("end", "width"), [((90.0, 20.0), 3.0), ((20.0, 90.0), 1.5), ((85.0, 70.0), 6.0)]
)
def test_lines_cover_as_much_as_they_should(end: tuple[float, float], width: float) -> None:
    frame = np.zeros((100, 100, 3), np.uint8)
    line(frame, (10.0, 15.0), end, (250, 0, 0), 1.0, width)
    length = math.hypot(end[0] - 10, end[1] - 15)
    assert math.isclose(frame[..., 0].sum() / 250, length * width, rel_tol=0.02)
    assert not frame[..., 1:].any()
    # Most of it lies on the line, and from the other end it is the same one.
    rows, columns = np.nonzero(frame[..., 0] > 125)
    across = (columns + 0.5 - 10) * (end[1] - 15) - (rows + 0.5 - 15) * (end[0] - 10)
    assert (np.abs(across) / length <= width / 2 + 0.5).all()
    along = (columns + 0.5 - 10) * (end[0] - 10) + (rows + 0.5 - 15) * (end[1] - 15)
    assert (along >= -0.5 * length).all()
    assert (along <= (length + 0.5) * length).all()
    back = np.zeros_like(frame)
    line(back, end, (10.0, 15.0), (250, 0, 0), 1.0, width)
    np.testing.assert_array_equal(back, frame)


def test_a_line_without_length_is_none() -> None:
    frame = np.zeros((20, 20, 3), np.uint8)
    for end in ((5.0, 5.0), (5.0, 5.0000001), (5.0000001, 5.0)):
        line(frame, (5.0, 5.0), end, (250, 0, 0), 1.0, 3.0)
    assert not frame.any()
    line(frame, (5.0, 5.0), (5.0, 5.6), (250, 0, 0), 1.0, 3.0)
    assert 0 < frame.sum() / 250 < 6


def test_what_reaches_beyond_a_frame_is_cut_off() -> None:
    whole_one, part = np.zeros((80, 80, 3), np.uint8), np.zeros((40, 40, 3), np.uint8)
    spot = disc(9.0, (200, 100, 50), 0.7)
    for left, top in ((-5, -5), (-60, 3), (30, 35), (40, 90), (10, -19)):
        stamp(whole_one, left + 20, top + 20, spot)
        stamp(part, left, top, spot)
    for ends in (((-30.0, 10.0), (90.0, 20.0)), ((10.0, -30.0), (50.0, 90.0))):
        line(whole_one, *[(x + 20, y + 20) for x, y in ends], (9, 200, 9), 0.6, 4.0)
        line(part, *ends, (9, 200, 9), 0.6, 4.0)
    np.testing.assert_array_equal(part, whole_one[20:60, 20:60])
    assert part.any()


def test_sprites_mix_with_what_is_below() -> None:
    frame = np.full((21, 21, 3), 100, np.uint8)
    stamp(frame, 0, 0, disc(10.0, (200, 0, 100), 0.25))
    np.testing.assert_allclose(frame[10, 10], [125, 75, 100], atol=2)
    np.testing.assert_array_equal(frame[0, 0], [100, 100, 100])
    covered = (frame[..., 0].astype(int) - 100).sum() / 25
    assert math.isclose(covered, math.pi * 10**2, rel_tol=0.06)
    both = over(disc(10.0, (0, 250, 0), 0.5), disc(10.0, (250, 0, 0), 1.0))
    stamp(frame, 0, 0, both)
    np.testing.assert_allclose(frame[10, 10], [125, 125, 0], atol=3)
    stamp(frame, 0, 0, faded(both, 0.0))
    np.testing.assert_allclose(frame[10, 10], [125, 125, 0], atol=3)


def test_labels_without_room_keep_the_number() -> None:
    def letters(radius: float, label: str) -> int:
        return int((body(radius, 1.0, (0, 0, 90), label).ink > 150).all(axis=2).sum())

    assert letters(30.0, "M12") > letters(30.0, "M1") > 0
    assert letters(30.0, "M12") != letters(30.0, "I12")
    assert 0 < letters(9.0, "M12") == letters(9.0, "I12")  # the number alone
    assert letters(3.0, "M") == 0


def test_pens_draw_in_cells() -> None:
    view = fit(Window(2.0, 4.0, 22.0, 14.0), (32, 32), LARGE)
    frame = np.zeros((1080, 1920, 3), np.uint8)
    Pen(frame, view).stamp((7.0, 9.0), disc(0.5 * view.scale, (255, 255, 255), 1.0))
    row, column = centre_of((frame > 125).all(axis=2))
    left, top, _, _ = view.box
    assert math.isclose((column + 0.5 - left) / view.scale + view.window.left, 7.0, abs_tol=0.02)
    assert math.isclose(view.window.top - (row + 0.5 - top) / view.scale, 9.0, abs_tol=0.02)


def test_policies_are_those_of_the_command_line() -> None:
    assert set(get_args(PolicyName)) == set(POLICIES)
