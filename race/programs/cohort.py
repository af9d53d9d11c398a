"""Programs of several runs at once, vmapped over them: what an accelerator is fed with.

Runs come as tuples of what `race.programs` takes of each; they are stacked inside. Replay buffers
are not: minibatches are drawn from each before.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from race.algorithms import Algorithm
from race.algorithms.base import Losses, Teams
from race.config.hyper import Hyper
from race.config.shape import Shape
from race.method.normalisation import Scaling
from race.programs import TRACES, joint_actions
from race.replay.buffer import Layout, Replay, sample, slots_of, sources_of
from race.replay.shown import as_shown
from race.types import EnvSpec, Slots, Spec


def stacked(trees: tuple[Any, ...]) -> Any:
    """One tree whose leaves have an axis of runs first."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


stack = jax.jit(stacked)
"""The same as a program."""


@partial(jax.jit, static_argnames=("room", "shape"))
def minibatches(
    replay: Replay,
    key: PRNGKeyArray,
    first_step: Int[Any, ""],
    *,
    hyper: Hyper,
    room: int,
    shape: Shape,
    scaling: Scaling | None = None,
) -> Any:
    """The minibatches of gradient steps from ``first_step`` on, ``room`` of them.

    They are those that `race.programs.learn` would draw.
    """
    TRACES["minibatches"] += 1
    sources = sources_of(replay)

    def one(i: Int[Array, ""]) -> Any:
        sample_key, _ = jax.random.split(jax.random.fold_in(key, first_step + i))
        drawn = sample(replay, shape.batch_size, sample_key, hyper.own_share, sources)
        return as_shown(drawn, scaling)

    return jax.vmap(one)(jnp.arange(room))


@jax.jit
def minibatches_of(replay: Replay, layouts: Layout, scaling: Scaling | None = None) -> Slots:
    """The minibatches of episodes of some layouts, one a step."""
    TRACES["minibatches"] += 1
    slots: Slots = as_shown(jax.vmap(slots_of, (None, 0))(replay, layouts), scaling)
    return slots


@partial(
    jax.jit,
    static_argnames=("algorithm", "spec", "shape"),
    donate_argnames=("states", "sums"),
)
def learn(
    states: tuple[Any, ...],
    sums: tuple[Losses, ...],
    batches: tuple[Any, ...],
    keys: tuple[PRNGKeyArray, ...],
    first_step: Int[Any, "C"],
    n_steps: Int[Any, "C"],
    *,
    hypers: tuple[Hyper, ...],
    algorithm: Algorithm,
    spec: Spec,
    shape: Shape,
) -> tuple[tuple[Any, ...], tuple[Losses, ...]]:
    """Gradient steps of several runs, of each as many as it has to make.

    Args:
        states: of the algorithm.
        sums: of losses.
        batches: minibatches, one a step, with an axis of at least ``max(n_steps)``.
        keys: as `race.programs.learn` takes them.
        first_step: number of each run's first step. On continuous actions it begins a policy
            period, so that all runs train their policies at the same moments.
        n_steps: of each run, 0 for one that has none to make; its state stays as it is.
        hypers: numbers of each run.
        algorithm: the same of all.
        spec: the task's.
        shape: the same of all.

    Returns:
        The states and ``sums`` with the steps' losses added.
    """
    TRACES["learn_cohort"] += 1
    batch, key, hyper = stacked(batches), stacked(keys), stacked(hypers)

    def one(
        i: Int[Array, ""],
        state: Any,
        sums: Losses,
        batch: Any,
        key: PRNGKeyArray,
        hyper: Hyper,
        first: Int[Array, ""],
        count: Int[Array, ""],
    ) -> tuple[Any, Losses]:
        _, update_key = jax.random.split(jax.random.fold_in(key, first + i))
        # Whether policies are trained must not differ among runs: both branches would be computed.
        number = first + i if shape.discrete else i
        now = jax.tree.map(lambda column: column[i], batch)
        after, critic, policy = algorithm.update(state, now, number, update_key, spec, shape, hyper)
        losses = critic | policy
        added = {name: sums[name] + losses[name] for name in sums}
        return _chosen(i < count, (after, added), (state, sums))

    def body(i: Int[Array, ""], carry: Any) -> Any:
        runs: Any = jax.vmap(one, (None, 0, 0, 0, 0, 0, 0, 0))
        return runs(i, *carry, batch, key, hyper, first_step, n_steps)

    longest = jnp.max(jnp.asarray(n_steps))
    state, total = jax.lax.fori_loop(0, longest, body, (stacked(states), stacked(sums)))
    return _apart(state, len(states)), _apart(total, len(states))


@partial(jax.jit, static_argnames=("spec", "base"))
def act(
    teams: Teams, state: Float[Any, "C T S"], *, spec: EnvSpec, base: str
) -> Float[Array, "C T U"]:
    """The joint actions of all teams of several runs; ``teams`` are stacked."""
    TRACES["act_cohort"] += 1
    return jax.vmap(partial(joint_actions, spec=spec, base=base))(teams, state)


def _chosen(here: Bool[Array, ""], one: Any, other: Any) -> Any:
    def choose(x: Any, y: Any) -> Any:
        return jnp.where(here, x, y)

    return jax.tree.map(choose, one, other)


def _apart(tree: Any, count: int) -> tuple[Any, ...]:
    def run(i: int) -> Any:
        return jax.tree.map(lambda leaf: leaf[i], tree)

    return tuple(map(run, range(count)))
