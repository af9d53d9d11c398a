"""Gradient steps: a network with its optimiser's state, clipping, target networks."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from race.config.hyper import Number


class Trainable(NamedTuple):
    """A network's parameters and the state of its own optimiser."""

    params: Any
    optimizer: optax.OptState


def _adam(learning_rate: Number, clip: Number) -> optax.GradientTransformation:
    return optax.chain(_clip_by_global_norm(clip), optax.adam(learning_rate))


def _clip_by_global_norm(clip: Number) -> optax.GradientTransformation:
    # Optax's own divides every entry in a pass of its own; this factor is multiplied into Adam's.
    def scaled(gradient: Any, params: Any) -> Any:
        squares = [jnp.sum(jnp.square(leaf)) for leaf in jax.tree.leaves(gradient)]
        factor = jnp.minimum(1.0, clip / jnp.sqrt(sum(squares)))
        return jax.tree.map(lambda g: factor * g, gradient)

    return optax.stateless(scaled)


def init_trainable(params: Any) -> Trainable:
    """A network before its first step. Adam's first state depends on no hyperparameter."""
    return Trainable(params, _adam(1.0, 1.0).init(params))


def descend(trained: Trainable, gradient: Any, learning_rate: Number, clip: Number) -> Trainable:
    """One Adam step along a gradient whose global norm is first clipped to ``clip``."""
    # Optax raises a float to an integer power, which strict promotion, where set, would refuse.
    with jax.numpy_dtype_promotion("standard"):
        updates, optimizer = _adam(learning_rate, clip).update(gradient, trained.optimizer)
    return Trainable(optax.apply_updates(trained.params, updates), optimizer)


def descend_plainly(params: Any, gradient: Any, learning_rate: Number, clip: Number) -> Any:
    """One step against a gradient whose global norm is first clipped; nothing is remembered."""
    clipped, _ = _clip_by_global_norm(clip).update(gradient, optax.EmptyState())
    return jax.tree.map(lambda p, g: p - learning_rate * g, params, clipped)


def parameters(trained: Any) -> Any:
    """The parameters of a tuple of `Trainable`, in a tuple of its kind; what is None stays None."""
    return type(trained)(*(None if part is None else part.params for part in trained))


def descend_all(trained: Any, gradient: Any, rates: Any, clip: Number) -> Any:
    """`descend` for each of a tuple of `Trainable`, with a rate each; what is None stays None."""
    parts = zip(trained, gradient, rates, strict=True)
    return type(trained)(
        *(None if part is None else descend(part, g, rate, clip) for part, g, rate in parts)
    )


def track(target: Any, online: Any, rate: Number) -> Any:
    """Moves a target network towards the online one: ``target + rate (online - target)``."""
    return jax.tree.map(lambda t, o: t + rate * (o - t), target, online)


def copy(params: Any) -> Any:
    """The same values in buffers of their own, so that both can be donated to a program."""
    return jax.tree.map(jnp.copy, params)


@jax.custom_vjp
def weigh_gradient(x: Any, weight: Number) -> Any:
    """``x`` itself, whose gradient is multiplied by ``weight`` on its way back."""
    return x


def _forward(x: Any, weight: Number) -> tuple[Any, Number]:
    return x, weight


def _backward(weight: Number, gradient: Any) -> tuple[Any, None]:
    return jax.tree.map(lambda g: g * weight, gradient), None


weigh_gradient.defvjp(_forward, _backward)


@jax.custom_vjp
def graft(x: Any, same: Any) -> Any:
    """``x``, whose gradient goes to ``same`` too, an equal array with other ancestors."""
    return x


graft.defvjp(lambda x, same: (x, None), lambda _, gradient: (gradient, gradient))
