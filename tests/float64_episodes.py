"""Recurrent FACMAC and RACE over it written a second time, in float64.

From the paper and from what the docstrings of `race` promise, episode by episode. What stands
behind the end of an episode is cut away before anything is worked out, so no mask is needed here.
"""

from typing import Any, NamedTuple

import jax
import numpy as np
from float64_factored import normal

NONE = np.zeros(0)


def float64(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), tree)


def relu(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0, x, 0.0)


def leaky(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0, x, 0.01 * x)


def elu(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0, x, np.expm1(np.minimum(x, 0.0)))


def sp(x: Any) -> Any:
    return np.logaddexp(0.0, x)


def sigmoid(x: Any) -> Any:
    return 1.0 / (1.0 + np.exp(-x))


def softmax(x: np.ndarray) -> np.ndarray:
    e = np.exp(x - x.max(axis=-1, keepdims=True))
    return e / e.sum(axis=-1, keepdims=True)


def dense(layer: Any, x: np.ndarray) -> np.ndarray:
    return np.asarray(x @ layer.weight + layer.bias)


class One(NamedTuple):
    """An episode of ``l`` steps without padding."""

    obs: np.ndarray  # [l + 1, N, O]
    state: np.ndarray  # [l + 1, S]
    available: np.ndarray  # [l + 1, N, A]
    action: np.ndarray  # [l, N]
    reward: np.ndarray  # [l]
    terminated: np.ndarray  # [l]

    @property
    def length(self) -> int:
        return len(self.reward)

    @property
    def taken(self) -> np.ndarray:
        return np.eye(self.available.shape[-1])[self.action]


def episodes_of(batch: Any) -> list[One]:
    """The episodes of a minibatch."""
    found = []
    for e, length in enumerate(np.asarray(batch.length)):
        found.append(
            One(
                np.asarray(batch.obs[e][: length + 1], np.float64),
                np.asarray(batch.state[e][: length + 1], np.float64),
                np.asarray(batch.avail_actions[e][: length + 1]),
                np.asarray(batch.action[e][:length], int),
                np.asarray(batch.reward[e][:length], np.float64),
                np.asarray(batch.terminated[e][:length], np.float64),
            )
        )
    return found


# --- networks ---------------------------------------------------------------------------------


def gru_moment(encoder: Any, h: np.ndarray, obs: np.ndarray, last: np.ndarray) -> np.ndarray:
    """z of all agents at one moment, ``[N, H]``; ``last`` is -1 at the first."""
    after, size = [], h.shape[1]
    for i in range(len(h)):
        x = obs[i] @ encoder.obs.weight + encoder.obs.bias + encoder.agent[i]
        if last[i] >= 0:
            x = x + encoder.last_action[last[i]]
        a_r, a_u, a_c = np.split(dense(encoder.into, relu(normal(encoder, x))), [size, 2 * size])
        h_r, h_u, h_c = np.split(dense(encoder.recurrent, h[i]), [size, 2 * size])
        r, u = sigmoid(a_r + h_r), sigmoid(a_u + h_u)
        after.append((1 - u) * np.tanh(a_c + r * h_c) + u * h[i])
    return np.stack(after)


def embeddings(encoder: Any, one: One) -> np.ndarray:
    """z at every moment of an episode, ``[l + 1, N, H]``."""
    agents = one.obs.shape[1]
    h = np.zeros((agents, encoder.recurrent.weight.shape[0]))
    z, last = [], np.full(agents, -1)
    for t in range(one.length + 1):
        h = gru_moment(encoder, h, one.obs[t], last)
        z.append(h)
        if t < one.length:
            last = one.action[t]
    return np.stack(z)


def scores_of(z: np.ndarray, head: np.ndarray) -> np.ndarray:
    """Logits ``[t, N, A]``: agent i through row i of a team, or all through the only one."""
    rows = [head[i if len(head) > 1 else 0] for i in range(z.shape[1])]
    return np.stack([z[:, i] @ w[:-1] + w[-1] for i, w in enumerate(rows)], axis=1)


def policy_embedding(pevfa: Any, head: np.ndarray) -> np.ndarray:
    """Three layers for each action's column of each agent, then their mean (Table 2)."""
    first, second, out = pevfa.embedding.layers
    columns = [agent[:, a] for agent in head for a in range(agent.shape[1])]
    return np.mean([dense(out, leaky(dense(second, leaky(dense(first, c))))) for c in columns], 0)


def q_tot(
    critic: Any,
    obs: np.ndarray,
    state: np.ndarray,
    action: np.ndarray,
    pevfa: Any = None,
    team: np.ndarray = NONE,
) -> np.ndarray:
    """``Q_tot`` of steps ``[t]``; the policy embedding is one more input of both networks.

    That of the team, or in an agent's utility of the agent's own head.
    """
    e = NONE if pevfa is None else policy_embedding(pevfa, team)
    net, mixer = critic.utilities, critic.mixer
    first, hyper = net.first.weight, mixer.first.weight
    if pevfa is not None:
        first = np.concatenate([first, pevfa.utility_weight])
        hyper = np.concatenate([hyper, pevfa.mixer_weight])
    steps, agents, _ = obs.shape
    q = np.empty((steps, agents))
    for i in range(agents):
        own = e
        if pevfa is not None and pevfa.of_agents:
            own = policy_embedding(pevfa, team[i : i + 1])
        x = np.concatenate([obs[:, i], action[:, i], np.tile(own, (steps, 1))], axis=1)
        x = relu(normal(net, x @ first + net.first.bias))
        q[:, i] = dense(net.out, relu(normal(net, dense(net.hidden, x))))[:, 0]
    g, m = mixer.weights_out.weight.shape
    x = np.concatenate([state, np.tile(e, (steps, 1))], axis=1) @ hyper + mixer.first.bias
    to_in, to_out, to_bias, bias_in = np.split(x, [g, 2 * g, 2 * g + m], axis=1)
    w_in = np.abs(dense(mixer.weights_in, relu(to_in))).reshape(steps, agents, m)
    w_out = np.abs(dense(mixer.weights_out, relu(to_out)))
    bias_out = dense(mixer.bias_out, relu(to_bias))[:, 0]
    mixed = elu(np.einsum("tn,tnm->tm", q, w_in) + bias_in)
    return np.asarray((mixed * w_out).sum(axis=1) + bias_out)


def v_zeta(value: Any, state: np.ndarray) -> np.ndarray:
    hidden, out = value.layers
    return dense(out, relu(dense(hidden, state)))[:, 0]


# --- targets ----------------------------------------------------------------------------------


def best_actions(encoder: Any, head: np.ndarray, one: One) -> np.ndarray:
    """One-hot, of the largest logit among the available actions, ``[l + 1, N, A]``."""
    logits = np.where(one.available, scores_of(embeddings(encoder, one), head), -np.inf)
    return np.eye(logits.shape[-1])[logits.argmax(axis=-1)]


def lambda_targets(one: One, values: np.ndarray, discount: float, mixture: float) -> np.ndarray:
    """The forward view: n-step returns weighted by ``(1 - lambda) lambda^(n - 1)``.

    ``values`` are of all moments, ``[l + 1]``; the longest return has the rest of the weight.
    """
    targets = []
    for t in range(one.length):
        total, n_max = 0.0, one.length - t
        for n in range(1, n_max + 1):
            n_step = sum(discount**k * one.reward[t + k] for k in range(n))
            ended = one.terminated[t + n - 1] == 1
            if not ended:
                n_step += discount**n * values[t + n]
            weight = mixture ** (n - 1) if n == n_max else (1 - mixture) * mixture ** (n - 1)
            total += weight * n_step
        targets.append(total)
    return np.array(targets)


def targets_of(
    episodes: list[One], target: Any, team: np.ndarray, discount: float, mixture: float
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Both targets of Eq. (1), per episode."""
    y_marl, y_team = [], []
    for one in episodes:
        u = best_actions(target.encoder, target.head, one)
        q = q_tot(target.critic, one.obs, one.state, u)
        y_marl.append(lambda_targets(one, q, discount, mixture))
        u = best_actions(target.encoder, team, one)
        q = q_tot(target.pevfa.critic, one.obs, one.state, u, target.pevfa, team)
        y_team.append(lambda_targets(one, q, discount, mixture))
    return y_marl, y_team


# --- losses -----------------------------------------------------------------------------------


def mean(per_episode: list[np.ndarray]) -> float:
    """``E_D``: over all steps that were made."""
    return float(np.mean(np.concatenate(per_episode)))


def critic_loss(critic: Any, episodes: list[One], y: list[np.ndarray]) -> float:
    q = [q_tot(critic, one.obs[:-1], one.state[:-1], one.taken) for one in episodes]
    return mean([(a - b) ** 2 for a, b in zip(q, y, strict=True)])


def pevfa_loss(pevfa: Any, team: np.ndarray, episodes: list[One], y: list[np.ndarray]) -> float:
    q = [
        q_tot(pevfa.critic, one.obs[:-1], one.state[:-1], one.taken, pevfa, team)
        for one in episodes
    ]
    return mean([(a - b) ** 2 for a, b in zip(q, y, strict=True)])


def value_loss(value: Any, episodes: list[One], best: list[np.ndarray]) -> float:
    v = [v_zeta(value, one.state[:-1]) for one in episodes]
    return mean([(a - b) ** 2 for a, b in zip(v, best, strict=True)])


class Sampled(NamedTuple):
    """A team's samples at the steps of a minibatch, at parameters where gradients are taken.

    ``anchor`` is the softmax there, so that ``hard + softmax - anchor`` is the sample, with the
    softmax's derivative: straight-through.
    """

    noise: list[np.ndarray]  # of each episode [l, N, A]
    hard: list[np.ndarray]
    anchor: list[np.ndarray]


def perturbed(z: np.ndarray, head: np.ndarray, one: One, noise: np.ndarray) -> np.ndarray:
    """Perturbed logits of the steps of an episode; unavailable actions are impossible."""
    logits = scores_of(z[: one.length], head) + noise
    return np.where(one.available[: one.length], logits, -np.inf)


def sampled(
    encoder: Any, head: np.ndarray, episodes: list[One], noise: list[np.ndarray]
) -> Sampled:
    logits = [
        perturbed(embeddings(encoder, one), head, one, g)
        for one, g in zip(episodes, noise, strict=True)
    ]
    hard = [np.eye(x.shape[-1])[x.argmax(axis=-1)] for x in logits]
    return Sampled(noise, hard, [softmax(x) for x in logits])


def policy_values(
    encoder: Any,
    head: np.ndarray,
    samples: Sampled,
    episodes: list[One],
    critic: Any,
    pevfa: Any = None,
    seen: np.ndarray | None = None,
) -> float:
    """``E_D[Q(s, pi(s))]`` of a team, of ``Q_theta`` if there is a PeVFA.

    ``seen``: the team that the PeVFA sees in place of the one that acts.
    """
    seen = head if seen is None else seen
    values = []
    for one, noise, hard, anchor in zip(episodes, *samples, strict=True):
        u = hard + softmax(perturbed(embeddings(encoder, one), head, one, noise)) - anchor
        values.append(q_tot(critic, one.obs[:-1], one.state[:-1], u, pevfa, seen))
    return mean(values)


def encoded(mine: Any, z: np.ndarray) -> np.ndarray:
    """Embeddings as MINE sees them: through one layer or two."""
    y = dense(mine.embedding, z)
    return y if mine.embedding_out is None else dense(mine.embedding_out, leaky(y))


def signals(mine: Any, encoder: Any, episodes: list[One], groups: Any) -> list[np.ndarray]:
    """``I_t`` below Eq. (3) of every step, per episode.

    ``groups`` lists the steps ``(episode, t)`` that were dealt out together; those behind the end
    of an episode are left out. An agent with one available action has no part.
    """
    y = [encoded(mine, embeddings(encoder, one)) for one in episodes]
    x = [dense(mine.state_out, leaky(dense(mine.state_hidden, one.state))) for one in episodes]
    result = [np.zeros(one.length) for one in episodes]
    for group in groups:
        real = [(e, t) for e, t in group if t < episodes[e].length]
        for e, t in real:
            of_agents = []
            for i in range(episodes[e].obs.shape[1]):
                living = [m for m in real if episodes[m[0]].available[m[1], i].sum() > 1]
                if (e, t) not in living:
                    continue
                score = {m: float(leaky(x[e][t]) @ y[m[0]][m[1], i]) for m in living}
                others = [sp(score[m]) for m in living if m != (e, t)]
                of_agents.append(-sp(-score[e, t]) - (np.mean(others) if others else 0.0))
            result[e][t] = np.mean(of_agents) if of_agents else 0.0
    return result


def signals_across(mine: Any, encoder: Any, episodes: list[One]) -> list[np.ndarray]:
    """The same, with the embeddings of all agents of other episodes at that time as negatives."""
    y = [encoded(mine, embeddings(encoder, one)) for one in episodes]
    x = [dense(mine.state_out, leaky(dense(mine.state_hidden, one.state))) for one in episodes]
    result = []
    for e, one in enumerate(episodes):
        found = []
        for t in range(one.length):

            def scores(of: int, e: int = e, t: int = t) -> list[float]:
                if t >= episodes[of].length:
                    return []
                living = episodes[of].available[t].sum(axis=-1) > 1
                return [float(leaky(x[e][t]) @ y[of][t, i]) for i in np.flatnonzero(living)]

            own = [-sp(-score) for score in scores(e)]
            others = [sp(s) for of in range(len(episodes)) if of != e for s in scores(of)]
            found.append(np.mean(own) - np.mean(others) if own and others else 0.0)
        result.append(np.array(found))
    return result


def min_max(values: list[np.ndarray]) -> list[np.ndarray]:
    """The weights of Eq. (5)."""
    every = np.concatenate(values)
    return [(v - every.min()) / (every.max() - every.min()) for v in values]
