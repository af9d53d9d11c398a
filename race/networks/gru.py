"""The recurrence of a GRU over time, fast forwards and backwards.

The three gates are kept apart throughout: the compiler turns parts of one array inside a loop into
slow code.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class Gates(NamedTuple):
    """Something of the reset gate, the update gate and the candidate."""

    reset: Array
    update: Array
    candidate: Array


def gru_step(
    weight: Gates, bias: Gates, carry: Float[Array, "R H"], inputs: Gates
) -> Float[Array, "R H"]:
    """One step (Cho et al. 2014, with the candidate's bias inside, as cuDNN and PyTorch have it).

    ``r = sigmoid(a_r + h U_r + b_r)``, ``u = sigmoid(a_u + h U_u + b_u)``,
    ``c = tanh(a_c + r (h U_c + b_c))``, ``h' = (1 - u) c + u h``.

    Args:
        weight: U, [H, H] each.
        bias: b, [H] each.
        carry: h, one row per sequence.
        inputs: a, what the inputs add, [R, H] each.
    """
    _, update, candidate, _ = _gates(weight, bias, carry, inputs)
    return candidate + update * (carry - candidate)


def _gates(weight: Gates, bias: Gates, carry: Array, inputs: Gates) -> tuple[Array, ...]:
    """r, u, c and the candidate's own part, for rows of any number."""
    own = [carry @ w + b[None] for w, b in zip(weight, bias, strict=True)]
    reset = jax.nn.sigmoid(inputs.reset + own[0])
    update = jax.nn.sigmoid(inputs.update + own[1])
    return reset, update, jnp.tanh(inputs.candidate + reset * own[2]), own[2]


@jax.custom_vjp
def gru(
    weight: Gates, bias: Gates, inputs: Gates, keep: Float[Array, "L R"]
) -> Float[Array, "L R H"]:
    """All states ``h_1 ... h_L`` of sequences, with ``h_0 = 0``.

    Args:
        weight: U, [H, H] each.
        bias: b, [H] each.
        inputs: a, [L, R, H] each.
        keep: 0 at a step that begins a sequence anew, from a state of 0; 1 elsewhere. It gets no
            gradient.
    """

    def step(carry: Array, now: tuple[Gates, Array]) -> tuple[Array, Array]:
        inputs, keep = now
        after = gru_step(weight, bias, carry * keep[:, None], inputs)
        return after, after

    begin = jnp.zeros(inputs.reset.shape[1:], inputs.reset.dtype)
    return jax.lax.scan(step, begin, (inputs, keep))[1]


_Saved = tuple[Gates, Gates, Gates, Array, Array]


def _forwards(weight: Gates, bias: Gates, inputs: Gates, keep: Array) -> tuple[Array, _Saved]:
    after = gru(weight, bias, inputs, keep)
    return after, (weight, bias, inputs, keep, after)


def _backwards(saved: _Saved, cotangent: Array) -> tuple[Gates, Gates, Gates, Array]:
    """What is not recurrent is computed for all steps at once.

    The loop carries the gradient of the state alone; gates are computed anew, which is faster than
    to store them in the loop, and gradients of weights are one product after it.
    """
    weight, bias, inputs, keep, after = saved
    size = after.shape[-1]
    before = jnp.concatenate([jnp.zeros_like(after[:1]), after[:-1]]) * keep[..., None]
    rows = before.reshape(-1, size)
    flat = Gates(*(a.reshape(-1, size) for a in inputs))
    r, u, c, own = _gates(weight, bias, rows, flat)
    # How the state after a step moves with what goes into the gates, the state before held fixed.
    to_candidate = (1.0 - u) * (1.0 - c * c)
    to_own = to_candidate * r
    slopes = Gates(to_candidate * own * r * (1.0 - r), (rows - c) * u * (1.0 - u), to_own)
    *slopes_by_step, u, to_candidate = jax.lax.optimization_barrier(
        tuple(s.reshape(after.shape) for s in (*slopes, u, to_candidate))
    )
    transposed = jax.lax.optimization_barrier(Gates(*(w.T for w in weight)))

    def step(ahead: Array, now: tuple[Array, ...]) -> tuple[Array, Array]:
        direct, reset, update, candidate, through, keep = now
        total = ahead + direct
        back = (total * reset) @ transposed.reset + (total * update) @ transposed.update
        back = back + (total * candidate) @ transposed.candidate + total * through
        return back * keep[:, None], total

    begin = jnp.zeros_like(after[0])
    total = jax.lax.scan(step, begin, (cotangent, *slopes_by_step, u, keep), reverse=True)[1]
    moved = Gates(*jax.lax.optimization_barrier(tuple(total * s for s in slopes_by_step)))
    by_row = Gates(*(m.reshape(-1, size) for m in moved))
    return (
        Gates(*(rows.T @ m for m in by_row)),
        Gates(*(jnp.sum(m, axis=0) for m in by_row)),
        Gates(moved.reset, moved.update, total * to_candidate),
        jnp.zeros_like(keep),
    )


gru.defvjp(_forwards, _backwards)
