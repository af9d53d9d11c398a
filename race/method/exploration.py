"""How a team with discrete actions explores, and how gradients pass through its choices."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

UNAVAILABLE = -1e9
"""The logit of an action that is not available: its probability is exactly 0 in float32."""


def masked(logits: Float[Array, "*b A"], available: Bool[Array, "*b A"]) -> Float[Array, "*b A"]:
    """Logits that leave unavailable actions no probability."""
    return jnp.where(available, logits, UNAVAILABLE)


def greedy(logits: Float[Array, "*b A"], available: Bool[Array, "*b A"]) -> Int[Array, "*b"]:
    """The available action of the largest logit."""
    return jnp.argmax(masked(logits, available), axis=-1).astype(jnp.int32)


def gumbel_softmax(
    logits: Float[Array, "*b A"], available: Bool[Array, "*b A"], noise: Float[Array, "*b A"]
) -> Float[Array, "*b A"]:
    """A one-hot sample of the policy whose gradient is that of a softmax (Jang et al. 2017).

    The sample is distributed as the softmax of the logits over the available actions. Its gradient
    is that of the softmax of the perturbed logits, at temperature 1: straight-through. Where only
    one action is available, the gradient is 0.

    Args:
        logits: of the policy.
        available: which actions can be chosen.
        noise: `jax.random.gumbel` of the logits' shape.
    """
    perturbed = masked(logits + noise, available)
    soft = jax.nn.softmax(perturbed, axis=-1)
    hard = jax.nn.one_hot(jnp.argmax(perturbed, axis=-1), logits.shape[-1], dtype=logits.dtype)
    return soft + jax.lax.stop_gradient(hard - soft)


def epsilon(step: int, start: float, finish: float, steps: int) -> float:
    """The share of random actions after ``step`` environment steps: linear, then constant."""
    return start + (finish - start) * min(step / steps, 1.0)


def explore(
    logits: Float[Array, "*b A"],
    available: Bool[Array, "*b A"],
    epsilon: Float[Array, "..."],
    key: PRNGKeyArray,
) -> Int[Array, "*b"]:
    """Samples of the policy, of which a share ``epsilon`` is uniform among available actions.

    Shares that are not the same for all choices have axes that broadcast to the choices'.
    """
    policy_key, uniform_key, choice_key = jax.random.split(key, 3)

    def sample(logits: Float[Array, "*b A"], key: PRNGKeyArray) -> Int[Array, "*b"]:
        return jax.random.categorical(key, masked(logits, available), axis=-1)

    sampled = sample(logits, policy_key)
    uniform = sample(jnp.zeros_like(logits), uniform_key)
    random = jax.random.uniform(choice_key, logits.shape[:-1]) < epsilon
    return jnp.where(random, uniform, sampled).astype(jnp.int32)
