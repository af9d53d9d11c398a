"""A team as named arrays and one function, which numpy, JAX and any other reader compute alike.

It is what `race.teams.team` acts with and `race.teams.export` writes. Weights have a leading axis
``G``: ``N``, or 1 where all agents share them. Padding is folded into the weights (zero rows), an
agent's number into biases; so that what is left is matrix products and activations.

================  =============================  ================================================
continuous        shape                          is
================  =============================  ================================================
``hidden.weight``   [G, O, h1]                   first layer of the encoders, then ``tanh``
``hidden.bias``     [N, h1]
``out.weight``      [G, h1, H]                   second layer, then ``tanh``: the embedding z
``out.bias``        [G, H]
``head.weight``     [N, H, A]                    the heads W, then ``tanh``
``head.bias``       [N, A]
``joint``           [U]                          place of each entry of the joint action in [N * A]
``low``, ``high``   [U]                          bounds of the joint action in its units
================  =============================  ================================================

==================  =====================  ========================================================
discrete            shape                  is
==================  =====================  ========================================================
``obs.weight``        [G, O, H]            first layer, of the observation
``action.weight``     [G, A, H]            the same, of the action before
``obs.bias``          [N, H]               then ``relu``
``into.weight``       [G, H, 3 H]          into the GRU's gates: reset, update, candidate
``into.bias``         [G, 3 H]
``memory.weight``     [G, H, 3 H]          from its state to its gates
``memory.bias``       [G, 3 H]
``head.weight``       [N, H, A]            the heads W: scores of actions
``head.bias``         [N, A]
==================  =====================  ========================================================

Where a run normalises what is observed, there are two more, ``obs.mean`` and ``obs.factor`` [N, O]:
observations go in as the environment shows them, and ``(obs - mean) * factor`` within +-10 is what
the networks see.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from race.method.normalisation import CLIP, Scaling
from race.networks.dense import VARIANCE_FLOOR, Encoder
from race.networks.recurrent import GruEncoder
from race.types import DiscreteSpec, EnvSpec, Spec

Arrays = Mapping[str, Any]
"""Of numpy or JAX."""

UNAVAILABLE = np.float32(-1e9)
"""The score of an action that cannot be chosen, as in `race.method.exploration`."""


class Portable(NamedTuple):
    """A team that needs neither JAX nor this library."""

    spec: Spec
    layer_norm: bool
    """Whether layers are normalised before their activation."""
    arrays: dict[str, NDArray[Any]]

    @property
    def memory_size(self) -> int:
        """Numbers that an agent carries from step to step: the GRU's state, and its last action."""
        if isinstance(self.spec, EnvSpec):
            return 0
        return int(self.arrays["head.weight"].shape[1]) + self.spec.n_actions


def portable(encoder: Any, heads: Any, spec: Spec, scaling: Scaling | None = None) -> Portable:
    """The portable form of a team.

    Args:
        encoder: of all agents: shared, or a network for each.
        heads: the policy representations [N, H + 1, A].
        spec: the task's.
        scaling: of what environments show; None: as it is.
    """
    if isinstance(spec, EnvSpec):
        assert isinstance(encoder, Encoder)
        arrays = _continuous(encoder, spec)
    else:
        assert isinstance(encoder, GruEncoder)
        arrays = _discrete(encoder)
    heads = np.asarray(heads)
    arrays |= {"head.weight": heads[:, :-1], "head.bias": heads[:, -1]}
    if isinstance(spec, EnvSpec):
        arrays["joint"] = spec.joint_gather.astype(np.int64)
        arrays["low"] = np.array(spec.action_low, np.float32)
        arrays["high"] = np.array(spec.action_high, np.float32)
    if scaling is not None:
        arrays |= _scaling(scaling, spec)
    arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    return Portable(spec, bool(encoder.layer_norm), arrays)


def _scaling(scaling: Scaling, spec: Spec) -> dict[str, NDArray[Any]]:
    if isinstance(spec, EnvSpec):
        seen, mask = spec.obs_gather, spec.obs_mask.astype(np.float32)
        mean, factor = (np.asarray(part)[seen] * mask for part in scaling.state)
    else:
        assert scaling.obs is not None
        mean, factor = (np.asarray(part) for part in scaling.obs)
    return {"obs.mean": mean, "obs.factor": factor}


def _continuous(encoder: Encoder, spec: EnvSpec) -> dict[str, NDArray[Any]]:
    weight = np.asarray(encoder.hidden.weight)
    if not spec.obs_mask.all():  # a network of all agents becomes one each, with zeros of its own
        weight = weight * spec.obs_mask[:, :, None].astype(np.float32)
    bias = np.asarray(encoder.hidden.bias)
    if encoder.agent is not None:
        bias = bias + np.asarray(encoder.agent)
    return {
        "hidden.weight": weight,
        "hidden.bias": np.broadcast_to(bias, (spec.n_agents, bias.shape[1])),
        "out.weight": np.asarray(encoder.out.weight),
        "out.bias": np.asarray(encoder.out.bias),
    }


def _discrete(encoder: GruEncoder) -> dict[str, NDArray[Any]]:
    own = encoder.recurrent.bias.ndim == 2  # one for each agent

    def led(array: Any) -> NDArray[Any]:
        return np.asarray(array) if own else np.asarray(array)[None]

    agent = np.asarray(encoder.agent)
    agent = agent[:, 0] if own else agent  # [N, H]
    return {
        "obs.weight": led(encoder.obs.weight),
        "action.weight": led(encoder.last_action),
        "obs.bias": led(encoder.obs.bias) + agent,
        "into.weight": led(encoder.into.weight),
        "into.bias": led(encoder.into.bias),
        "memory.weight": led(encoder.recurrent.weight),
        "memory.bias": led(encoder.recurrent.bias),
    }


def of_agent(team: Portable, agent: int) -> Portable:
    """One agent as a team of its own, without padding: its sizes, its entries of the action.

    Its observation is [1, O_i] and its action [A_i], in the order of ``obs_index`` and
    ``action_index``.
    """
    arrays = {}
    for name, array in team.arrays.items():
        if name not in ("joint", "low", "high"):
            arrays[name] = array[agent : agent + 1] if len(array) > 1 else array
    spec = team.spec
    if isinstance(spec, DiscreteSpec):
        one: Spec = DiscreteSpec(
            spec.task, 1, spec.obs_size, spec.state_size, spec.n_actions, spec.episode_limit
        )
    else:
        seen, moved = spec.obs_sizes[agent], spec.action_sizes[agent]
        entries = list(spec.action_index[agent])
        low, high = (tuple(team.arrays[name][entries].tolist()) for name in ("low", "high"))
        one = EnvSpec(
            task=spec.task,
            state_size=seen,
            obs_index=(tuple(range(seen)),),
            action_index=(tuple(range(moved)),),
            action_low=low,
            action_high=high,
            episode_limit=spec.episode_limit,
        )
        arrays["hidden.weight"] = arrays["hidden.weight"][:, :seen]
        for name in ("obs.mean", "obs.factor"):
            if name in arrays:
                arrays[name] = arrays[name][:, :seen]
        for name in ("head.weight", "head.bias"):
            arrays[name] = arrays[name][..., :moved]
        arrays["joint"] = np.arange(moved)
        arrays["low"], arrays["high"] = (team.arrays[name][entries] for name in ("low", "high"))
    arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    return Portable(one, team.layer_norm, arrays)


def joint_action(xp: Any, arrays: Arrays, layer_norm: bool, obs: Any) -> Any:
    """The joint actions of a team with continuous actions, in the environment's units.

    Args:
        xp: ``numpy`` or ``jax.numpy``.
        arrays: of a `Portable`, in ``xp``'s own type.
        layer_norm: of it.
        obs: what the agents observe, [B, N, O], padded.

    Returns:
        [B, U].
    """
    x = xp.moveaxis(_shown(xp, obs, arrays), 1, 0)  # [N, B, O]
    for layer in ("hidden", "out"):
        x = _layer(xp, x, arrays[f"{layer}.weight"], arrays[f"{layer}.bias"])
        x = xp.tanh(_normalised(xp, x) if layer_norm else x)
    x = xp.tanh(_layer(xp, x, arrays["head.weight"], arrays["head.bias"]))
    flat = xp.moveaxis(x, 0, 1).reshape(x.shape[1], x.shape[0] * x.shape[2])
    chosen = flat[:, arrays["joint"]]
    low, high = arrays["low"][None], arrays["high"][None]
    # As `race.envs.contract.in_units`: a range around 0 is scaled by one exact product.
    shifted = xp.clip(low + (chosen + 1) / 2 * (high - low), low, high)
    return xp.where(low == -high, chosen * high, shifted)


def next_actions(
    xp: Any, arrays: Arrays, layer_norm: bool, obs: Any, memory: Any, avail_actions: Any
) -> tuple[Any, Any]:
    """The actions of a team that remembers, and what it carries on.

    Args:
        xp: ``numpy`` or ``jax.numpy``.
        arrays: of a `Portable`, in ``xp``'s own type.
        layer_norm: of it.
        obs: what the agents observe, [B, N, O].
        memory: what they carry, [B, N, H + A]: the GRU's state, then the last action as a
            one-hot; zeros at the beginning of an episode.
        avail_actions: which actions can be chosen, bool [B, N, A].

    Returns:
        Actions [B, N], of int32, and the next memory.
    """
    size = arrays["head.weight"].shape[1]
    obs, memory = xp.moveaxis(_shown(xp, obs, arrays), 1, 0), xp.moveaxis(memory, 1, 0)
    carry, last = memory[..., :size], memory[..., size:]
    x = xp.matmul(last, arrays["action.weight"])
    x = x + _layer(xp, obs, arrays["obs.weight"], arrays["obs.bias"])
    x = _normalised(xp, x) if layer_norm else x
    x = xp.maximum(x, np.float32(0))
    into = _layer(xp, x, arrays["into.weight"], arrays["into.bias"])
    own = _layer(xp, carry, arrays["memory.weight"], arrays["memory.bias"])
    # `race.networks.gru.gru_step`.
    both = _sigmoid(xp, into[..., : 2 * size] + own[..., : 2 * size])
    reset, update = both[..., :size], both[..., size:]
    candidate = xp.tanh(into[..., 2 * size :] + reset * own[..., 2 * size :])
    carry = candidate + update * (carry - candidate)
    scores = xp.moveaxis(_layer(xp, carry, arrays["head.weight"], arrays["head.bias"]), 0, 1)
    action = xp.argmax(xp.where(avail_actions, scores, UNAVAILABLE), axis=-1)
    chosen = xp.arange(scores.shape[-1])[None, None] == action[..., None]
    memory = xp.concatenate([xp.moveaxis(carry, 0, 1), chosen.astype(np.float32)], axis=-1)
    return action.astype(np.int32), memory


def _shown(xp: Any, obs: Any, arrays: Arrays) -> Any:
    """As `race.method.normalisation.scaled`, where the team has it."""
    if "obs.mean" not in arrays:
        return obs
    apart = (obs - arrays["obs.mean"][None]) * arrays["obs.factor"][None]
    return xp.clip(apart, np.float32(-CLIP), np.float32(CLIP))


def _layer(xp: Any, x: Any, weight: Any, bias: Any) -> Any:
    return xp.matmul(x, weight) + bias[:, None]


def _normalised(xp: Any, x: Any) -> Any:
    centred = x - xp.mean(x, axis=-1, keepdims=True)
    variance = xp.mean(centred * centred, axis=-1, keepdims=True)
    return centred / xp.sqrt(variance + np.float32(VARIANCE_FLOOR))


def _sigmoid(xp: Any, x: Any) -> Any:
    # By the hyperbolic tangent, which does not overflow.
    return xp.tanh(x * np.float32(0.5)) * np.float32(0.5) + np.float32(0.5)
