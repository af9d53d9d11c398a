"""Many battles of a policy, and how they ended."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from race.envs.micro import Battle, smac
from race.envs.micro.policies import Policy
from race.envs.micro.scenario import Scenario


class Results(NamedTuple):
    """How ``B`` battles went."""

    won: Bool[Any, "B"]
    timed_out: Bool[Any, "B"]
    episode_return: Float[Any, "B"]
    episode_length: Int[Any, "B"]


def play(battle: Battle, policy: Policy, key: Key[Array, ""], battles: int) -> Results:
    """Plays battles to their ends, all at once."""
    results = _play(policy, battles, battle.spec.episode_limit, battle.scenario, key)
    return Results(*map(np.asarray, results))


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def _play(
    policy: Policy, battles: int, limit: int, scenario: Scenario, key: Key[Array, ""]
) -> Results:
    def one(key: Key[Array, ""]) -> Results:
        def going(carry: Any) -> Any:
            return ~carry[0].over

        def step(carry: Any) -> Any:
            env_state, observation, key, results = carry
            key, act_key, step_key = jax.random.split(key, 3)
            actions = policy(scenario, env_state, observation, act_key)
            env_state, timestep = smac.step(scenario, env_state, actions, step_key)
            results = Results(
                won=timestep.info.battle_won,
                timed_out=timestep.info.timed_out,
                episode_return=results.episode_return + timestep.reward,
                episode_length=results.episode_length + 1,
            )
            return env_state, timestep.observation, key, results

        env_state, observation = smac.reset(scenario, key)
        no = jnp.zeros((), bool)
        begin = Results(no, no, jnp.zeros(()), jnp.zeros((), int))
        results: Results = jax.lax.while_loop(going, step, (env_state, observation, key, begin))[-1]
        return results

    return jax.vmap(one)(jax.random.split(key, battles))
