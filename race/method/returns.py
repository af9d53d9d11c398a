"""Lambda returns over whole episodes, the targets of recurrent learners."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from race.config.hyper import Number


def lambda_returns(
    reward: Float[Array, "T *b"],
    terminated: Float[Array, "T *b"],
    next_value: Float[Array, "T *b"],
    acted: Bool[Array, "T *b"],
    discount: Number,
    td_lambda: Number,
) -> Float[Array, "T *b"]:
    """TD(lambda) targets of every step of a batch of episodes (Sutton & Barto 2018, Section 12.1).

    ``G_t = r_t + gamma (1 - terminated_t) ((1 - lambda) Q(s_{t+1}) + lambda G_{t+1})``, and at the
    last step of an episode ``r_t + gamma (1 - terminated_t) Q(s_{t+1})``: an episode that was cut
    off bootstraps from where it was cut.

    Args:
        reward: r_t.
        terminated: 1 at a step that ended the task itself.
        next_value: the target networks' ``Q(s_{t+1}, pi(s_{t+1}))``.
        acted: where steps were made; an episode ends where the next place has none.
        discount: gamma.
        td_lambda: lambda.

    Returns:
        The targets; 0 where no step was made, whatever stands there.
    """

    def back(
        ahead: tuple[Array, Array], step: tuple[Array, Array, Array, Array]
    ) -> tuple[tuple[Array, Array], Float[Array, "*b"]]:
        later, goes_on = ahead
        r, ended, value, made = step
        mixed = jnp.where(goes_on, (1.0 - td_lambda) * value + td_lambda * later, value)
        # Where the task ended nothing follows, not even a NaN.
        target = r + jnp.where(ended > 0, 0.0, discount * mixed)
        target = jnp.where(made, target, 0.0)
        return (target, made), target

    nothing = jnp.zeros(reward.shape[1:], reward.dtype), jnp.zeros(reward.shape[1:], bool)
    steps = (reward, terminated, next_value, acted)
    return jax.lax.scan(back, nothing, steps, reverse=True)[1]
