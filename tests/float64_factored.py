"""The factored critic written a second time: one sample, in float64, without padding.

From the docstrings of `race.networks.factored`: utilities of ReLU layers, hypernetworks of two ReLU
layers, and a policy embedding as further inputs of every first layer.
"""

from typing import Any

import numpy as np

from race.types import EnvSpec


def relu(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0, x, 0.0)


def elu(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0, x, np.exp(np.minimum(x, 0.0)) - 1.0)


def normal(network: Any, x: np.ndarray) -> np.ndarray:
    """A layer of one sample or several, of mean 0 and variance 1 where the network normalises."""
    if not network.layer_norm:
        return x
    return (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-5)


def utility(
    critic: Any,
    agent: int,
    spec: EnvSpec,
    s: np.ndarray,
    u: np.ndarray,
    e: np.ndarray,
    e_weight: np.ndarray,
) -> float:
    """``Q_i(o_i, u_i)`` of an agent's own network; ``e`` may be empty."""
    net = critic.utilities
    obs, own = s[list(spec.obs_index[agent])], u[list(spec.action_index[agent])]
    weight = net.first.weight[agent]
    rows = np.concatenate([weight[: len(obs)], weight[spec.obs_size :][: len(own)], e_weight])
    x = relu(normal(net, np.concatenate([obs, own, e]) @ rows + net.first.bias[agent]))
    x = relu(normal(net, x @ net.hidden.weight[agent] + net.hidden.bias[agent]))
    return float((x @ net.out.weight[agent] + net.out.bias[agent])[0])


def mixed(mixer: Any, s: np.ndarray, q: np.ndarray, e: np.ndarray, e_weight: np.ndarray) -> float:
    """``v(s) + |w_2(s)| elu(|W_1(s)| q + b_1(s))``."""
    g, m = mixer.weights_out.weight.shape
    x = np.concatenate([s, e]) @ np.concatenate([mixer.first.weight, e_weight]) + mixer.first.bias
    to_weights_in, to_weights_out, to_bias_out, bias_in = np.split(x, [g, 2 * g, 2 * g + m])

    def second(layer: Any, hidden: np.ndarray) -> np.ndarray:
        return np.asarray(relu(hidden) @ layer.weight + layer.bias)

    weights_in = np.abs(second(mixer.weights_in, to_weights_in)).reshape(len(q), m)
    weights_out = np.abs(second(mixer.weights_out, to_weights_out))
    (bias_out,) = second(mixer.bias_out, to_bias_out)
    return float(elu(q @ weights_in + bias_in) @ weights_out + bias_out)


def q_tot(critic: Any, spec: EnvSpec, s: np.ndarray, u: np.ndarray) -> float:
    """``Q_psi(s, u)``."""
    return _q_tot(critic, spec, s, u, np.zeros(0), None)


def q_tot_team(
    pevfa: Any, spec: EnvSpec, s: np.ndarray, u: np.ndarray, e: np.ndarray, own: Any = None
) -> float:
    """``Q_theta(s, u, W)`` of a team whose policy embedding is ``e``.

    ``own`` are embeddings of its agents, which their utilities take instead.
    """
    return _q_tot(pevfa.critic, spec, s, u, e, pevfa, own)


def _q_tot(
    critic: Any,
    spec: EnvSpec,
    s: np.ndarray,
    u: np.ndarray,
    e: np.ndarray,
    pevfa: Any,
    own: Any = None,
) -> float:
    width = critic.utilities.first.weight.shape[-1]
    shared = critic.mixer.first.weight.shape[-1]
    q = [
        utility(
            critic,
            i,
            spec,
            s,
            u,
            e if own is None else own[i],
            np.zeros((0, width)) if pevfa is None else pevfa.utility_weight[i],
        )
        for i in range(spec.n_agents)
    ]
    weight = np.zeros((0, shared)) if pevfa is None else pevfa.mixer_weight
    return mixed(critic.mixer, s, np.array(q), e, weight)
