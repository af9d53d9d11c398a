"""A minibatch of tiny unequal episodes, and a gradient step on it whose draws are known."""

import dataclasses
import sys
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from race.algorithms import race
from race.config.hyper import hyper_of
from race.config.settings import Config, FacmacConfig
from race.config.shape import shape_of
from race.types import DiscreteSpec, Episode, Slots

N, OBS, S, A, H, E, T = 3, 5, 6, 4, 5, 4, 5
LENGTHS = (5, 2, 3, 4)
SPEC = DiscreteSpec("tiny", N, OBS, S, A, T)
TARGET_EVERY = 2
GROUP = 4
"""Steps among which MINE's pairs are made, here."""


def random_batch() -> Episode:
    """Unequal episodes, one cut off by an outer limit, with agents that die on the way.

    Available are no-ops (action 0) alone to the dead, and never to the living.
    """
    rng = np.random.default_rng(3)
    obs, state = rng.normal(size=(E, T + 1, N, OBS)), rng.normal(size=(E, T + 1, S))
    available = rng.random((E, T + 1, N, A)) < 0.6
    available[..., 0] = False
    available[..., 2] = True
    # Agent 2 of episode 0 dies before step 2, agent 0 of episode 3 before step 1, agent 1 of
    # episode 1 was never alive, and all of episode 2 are dead at its last step.
    for e, i, t in ((0, 2, 2), (3, 0, 1), (1, 1, 0), (2, 0, 2), (2, 1, 2), (2, 2, 2)):
        obs[e, t:, i] = 0.0
        available[e, t:, i] = np.eye(A)[0] > 0
    action = np.where(available, rng.random(available.shape), -1.0).argmax(axis=-1)[:, :T]
    reward, terminated = rng.normal(size=(E, T)), np.zeros((E, T))
    for e, length in enumerate(LENGTHS):
        terminated[e, length - 1] = e != 1
    columns = [obs, state, available, action, reward, terminated]
    types = (np.float16, np.float16, bool, np.uint8, np.float32, np.float32)
    typed = [x.astype(t) for x, t in zip(columns, types, strict=True)]
    return Episode(*typed, np.array(LENGTHS, np.int32))


def tiny_facmac(
    tiny_config: Callable[..., Config], layer_norm: bool = False, **race: Any
) -> Config:
    """RACE over FACMAC with tiny networks, all of unequal sizes."""
    facmac = FacmacConfig(
        mixer_size=3,
        hypernet_size=4,
        hidden_size=H,
        layer_norm=layer_norm,
        utility_sizes=(6, 5),
        gradient_clip=1e6,
        discount=0.9,
        td_lambda=0.7,
        target_update_every=TARGET_EVERY,
    )
    tiny = tiny_config("race", "facmac", race={"population_size": 4, "elite_copy": False, **race})
    return dataclasses.replace(tiny, discrete=True, facmac=facmac)


def start(config: Config) -> Any:
    """A fresh state of RACE, with targets and heads away from the online networks."""
    shape, hyper = shape_of(config), hyper_of(config)
    state = jax.jit(partial(race.init, spec=SPEC, shape=shape, hyper=hyper))(jax.random.key(11))
    leaves, structure = jax.tree.flatten(state.target)
    rng = np.random.default_rng(28)
    moved = [x + jnp.asarray(0.3 * rng.normal(size=x.shape), jnp.float32) for x in leaves]
    target = jax.tree.unflatten(structure, moved)
    return with_heads(state._replace(target=target), 2.0 * state.heads)


def with_heads(state: Any, heads: Any) -> Any:
    """The state with other teams in its population."""
    teams = state.population.teams._replace(heads=heads)
    return state._replace(population=state.population._replace(teams=teams))


class Laid(NamedTuple):
    """Episodes laid end to end, and where: slot and row of each step ``(episode, t)``."""

    slots: Slots
    where: dict[tuple[int, int], tuple[int, int]]

    def steps(self, flat: Any) -> list[np.ndarray]:
        """Samples ``[B]``, time first, by episode."""
        values = np.asarray(flat)
        values = values.reshape(self.slots.real.shape[0] - 1, -1, *values.shape[1:])
        episodes = sorted({e for e, _ in self.where})
        return [
            np.stack([values[place] for (of, _), place in self.where.items() if of == e])
            for e in episodes
        ]

    @property
    def sample_of(self) -> dict[tuple[int, int], int]:
        """The sample that each step is."""
        rows = self.slots.real.shape[1]
        return {step: slot * rows + row for step, (slot, row) in self.where.items()}


PACKED = ((0, 2), (3, 1))
"""Two rows of two episodes; the second has empty slots at its end."""


def laid_out(
    batch: Episode,
    junk_seed: int | None,
    rows: tuple[tuple[int, ...], ...] = PACKED,
    size: int = 10,
) -> Laid:
    """Episodes in rows; where no step was made stand zeros or junk, only the flags are true."""
    rng = np.random.default_rng(junk_seed)
    shape = (size, len(rows))

    def empty(high: int, dtype: Any, *further: int) -> np.ndarray:
        junk = rng.integers(0, high, (*shape, *further))
        return (junk * (junk_seed is not None)).astype(dtype)

    slots = Slots(
        obs=empty(40, np.float16, N, OBS),
        state=empty(40, np.float16, S),
        avail_actions=empty(2, bool, N, A),
        action=empty(A, np.uint8, N),
        last_action=empty(A, np.int32, N),
        reward=empty(40, np.float32),
        terminated=empty(2, np.float32),
        first=np.zeros(shape, bool),
        acted=np.zeros(shape, bool),
        real=np.zeros(shape, bool),
        moment=empty(40, np.int32),
    )
    where = {}
    for row, episodes in enumerate(rows):
        slot = 0
        for e in episodes:
            length = int(batch.length[e])
            for t in range(length + 1):
                here = (slot, row)
                for name in ("obs", "state", "avail_actions"):
                    getattr(slots, name)[here] = getattr(batch, name)[e, t]
                slots.last_action[here] = batch.action[e, t - 1] if t else -1
                slots.first[here], slots.real[here] = t == 0, True
                slots.acted[here] = t < length
                slots.moment[here] = e * (T + 1) + t
                if t < length:
                    where[e, t] = here
                    for name in ("action", "reward", "terminated"):
                        getattr(slots, name)[here] = getattr(batch, name)[e, t]
                slot += 1
    return Laid(Slots(*map(jnp.asarray, slots)), where)


def groups_of(laid: Laid, deal: Any) -> list[list[tuple[int, int]]]:
    """The steps that were dealt out together; places of a deal that are no steps are left out."""
    step_at = {place: step for step, place in laid.sample_of.items()}
    groups = (deal[start : start + GROUP] for start in range(0, len(deal), GROUP))
    return [[step_at[int(i)] for i in group if int(i) in step_at] for group in groups]


class Draws(NamedTuple):
    """What `jax.random` gave to a gradient step."""

    noise: list[np.ndarray]
    deals: list[np.ndarray]


class Step(NamedTuple):
    before: Any
    after: Any
    losses: dict[str, float]
    draws: Draws


def stepper(config: Config, algorithm: Any, fixed: bool) -> Callable[..., Step]:
    """A compiled gradient step whose draws are recorded.

    ``fixed``: draws that depend on the key and the time in an episode alone, and steps dealt out
    in one order, wherever they lie; what is no step is dealt out last.
    """
    draws = Draws([], [])
    laid: list[Laid] = []
    module, pairs = sys.modules["race.learners.facmac"], sys.modules["race.learners.signals"]
    gumbel_noise, deal_out = module.gumbel_noise, pairs.deal_out

    def record(kept: list[np.ndarray], values: Any) -> Any:
        jax.debug.callback(lambda x: kept.append(np.asarray(x)), values)
        return values

    def noise(key: Any, moment: Any, shape: tuple[int, ...]) -> Any:
        if not fixed:
            return record(draws.noise, gumbel_noise(key, moment, shape))
        times = np.zeros(moment.shape, int)
        for (_, t), place in laid[0].where.items():
            times[place] = t
        rows = [jax.random.gumbel(jax.random.fold_in(key, t), shape) for t in range(T)]
        return jnp.stack(rows)[times]

    def deal(key: Any, moment: Any, real: Any) -> Any:
        if not fixed:
            return record(draws.deals, deal_out(key, moment, real))
        order = np.random.default_rng(0).permutation(len(laid[0].where))
        samples = np.array([laid[0].sample_of[step] for step in sorted(laid[0].where)])[order]
        rest = np.setdiff1d(np.arange(moment.size), samples)
        return jnp.asarray(np.concatenate([samples, rest]))

    update = jax.jit(
        partial(algorithm.update, spec=SPEC, shape=shape_of(config), hyper=hyper_of(config))
    )

    def step(before: Any, batch: Laid, number: int = 1) -> Step:
        laid[:] = [batch]
        for kept in draws:
            kept.clear()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(pairs, "GROUP", GROUP)
            patch.setattr(module, "gumbel_noise", noise)
            patch.setattr(pairs, "deal_out", deal)
            after, critics, policies = update(
                before, batch.slots, jnp.int32(number), jax.random.key(5)
            )
        jax.effects_barrier()
        losses = {name: float(x) for name, x in (critics | policies).items()}
        return Step(before, after, losses, Draws(*map(list, draws)))

    return step
