"""What the probes draw, on the host and on the device."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, Key

from race.envs.discrete_probe.rules import LIVES_AGENTS, LIVES_STEPS, MATCHING_ACTIONS


@jax.jit
def draw_matching(key: Key[Array, ""]) -> tuple[Int[Array, "2"], Bool[Array, "2 A"]]:
    """Cues, and actions that are blocked unless they are right."""
    cue_key, block_key = jax.random.split(key)
    cues = jax.random.randint(cue_key, (2,), 0, MATCHING_ACTIONS, jnp.int32)
    return cues, jax.random.bernoulli(block_key, 0.5, (2, MATCHING_ACTIONS))


@jax.jit
def draw_memory(key: Key[Array, ""]) -> Int[Array, "2"]:
    """Cues."""
    return jax.random.randint(key, (2,), 0, 2, jnp.int32)


@jax.jit
def draw_lives(key: Key[Array, ""]) -> Int[Array, "N"]:
    """Cues of a moment, for the dead as well."""
    return jax.random.randint(key, (LIVES_AGENTS,), 1, 3, jnp.int32)


@jax.jit
def draw_lives_start(key: Key[Array, ""]) -> tuple[Int[Array, ""], Int[Array, "N"]]:
    """Steps of the episode, and the first cues."""
    length_key, cue_key = jax.random.split(key)
    fewest, most = LIVES_STEPS
    length = jax.random.randint(length_key, (), fewest, most + 1, jnp.int32)
    return length, draw_lives(cue_key)
