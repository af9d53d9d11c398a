"""Many battles of a policy, and how they ended.

    python -m race.envs.micro.tournament [--battles 1000] [MAP ...]

prints how often each policy wins on each map.
"""

import argparse
import functools
import sys
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from race.envs.micro import Battle, make, map_names, smac
from race.envs.micro.policies import POLICIES, Policy
from race.envs.micro.scenario import Scenario
from race.errors import RaceError


class Results(NamedTuple):
    """How ``B`` battles went."""

    won: Bool[Any, "B"]
    timed_out: Bool[Any, "B"]
    episode_return: Float[Any, "B"]
    episode_length: Int[Any, "B"]


def play(battle: Battle, policy: Policy, key: Key[Array, ""], battles: int) -> Results:
    """Plays battles to their ends, all at once."""
    results = _play(policy, battles, battle.scenario, key)
    return Results(*map(np.asarray, results))


@functools.partial(jax.jit, static_argnums=(0, 1))
def _play(policy: Policy, battles: int, scenario: Scenario, key: Key[Array, ""]) -> Results:
    def one(key: Key[Array, ""]) -> Results:
        def going(carry: Any) -> Any:
            return ~carry[0].over

        def step(carry: Any) -> Any:
            env_state, observation, key, results = carry
            key, act_key, step_key = jax.random.split(key, 3)
            actions = policy.choose(scenario, env_state, observation, act_key)
            env_state, timestep = smac.step(
                scenario, env_state, actions, step_key, any_distance=policy.any_distance
            )
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


def main(arguments: list[str] | None = None) -> int:
    """Plays the battles and prints a table; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m race.envs.micro.tournament",
        description="How often policies win that have learned nothing.",
    )
    parser.add_argument("maps", nargs="*", metavar="MAP", help="all maps, if none is named")
    parser.add_argument("--battles", type=int, default=1000, help="per map and policy (1000)")
    parser.add_argument("--seed", type=int, default=0, help="of all battles (0)")
    chosen = parser.parse_args(arguments)
    if chosen.battles < 1 or chosen.seed < 0:
        parser.error("--battles must be 1 or more, --seed 0 or more")
    print(f"{'map':<18}{'policy':<10}{'won':>7}{'timed out':>11}{'return':>8}{'steps':>7}")
    for name in chosen.maps or map_names():
        for policy_name, policy in POLICIES.items():
            try:
                results = play(make(name), policy, jax.random.key(chosen.seed), chosen.battles)
            except RaceError as error:
                print(error, file=sys.stderr)
                return 2
            print(
                f"{name:<18}{policy_name:<10}{results.won.mean():>7.1%}"
                f"{results.timed_out.mean():>11.1%}{results.episode_return.mean():>8.2f}"
                f"{results.episode_length.mean():>7.1f}",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
