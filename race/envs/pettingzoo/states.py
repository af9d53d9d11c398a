"""What the global state of a PettingZoo environment is."""

from typing import Any, Final

import numpy as np
from gymnasium import spaces

from race.config.settings import EnvConfig
from race.envs import contract
from race.envs.pettingzoo.parallel import Parallel
from race.envs.pettingzoo.vectors import Choices, Sight
from race.errors import HandedOverError, TaskError

_LOOKS: Final = 5
"""Random steps in which the environment's own state is compared with what its agents observe."""


def own_state(parallel: Parallel, config: EnvConfig) -> Sight | None:
    """How the environment's own state becomes a vector, where it is the state of the task.

    Raises:
        TaskError: if it is asked for and there is none, or is none that can be learned.
    """
    if config.state == "observations":
        return None
    parallel.reset(0)
    found = _sight_of_state(parallel)
    if config.state == "environment":
        if found is None:
            raise TaskError(
                "it has no state() of its own: leave out --env.state environment, or let "
                "state() return an array."
            )
        refuse_large(found.size, "its state()", config)
        return found
    if found is None or not 1 <= found.size <= config.largest_observation:
        return None
    return None if _is_observations(parallel, found) else found


def _sight_of_state(parallel: Parallel) -> Sight | None:
    """How ``state()`` becomes a vector; None if there is none. Call it after a reset."""
    env = parallel.env
    if not callable(getattr(env, "state", None)):
        return None
    try:
        value = env.state()
    except NotImplementedError:  # what PettingZoo raises where there is none
        return None
    if value is None:
        return None
    space = getattr(env, "state_space", None)
    if not isinstance(space, spaces.Space):
        try:
            shape = np.asarray(value, np.float32).shape
        except (TypeError, ValueError) as error:
            raise TaskError(
                f"its state() returned {contract.came(value)} and it has no state_space. Let it "
                "return an array, declare the space, or use --env.state observations."
            ) from error
        space = spaces.Box(-np.inf, np.inf, shape, np.float32)
    sight = Sight(space, "what state() returned")
    try:
        sight(value)
    except HandedOverError as error:
        raise TaskError(
            f"{error}. Let state() be of its state_space, or use --env.state observations."
        ) from error
    return sight


def _is_observations(parallel: Parallel, own: Sight) -> bool:
    """Whether the state is what all agents observe, one after the other, in a few random steps."""
    if own.size != sum(sight.size for sight in parallel.sights.values()):
        return False
    random = np.random.default_rng(0)
    for step in range(_LOOKS + 1):
        _, seen = parallel.seen(parallel.agents)
        if not np.array_equal(own(parallel.env.state()), seen):
            return False
        if step < _LOOKS and any(parallel.step(random_actions(parallel, random))):
            parallel.reset(step + 1)
    return True


def random_actions(parallel: Parallel, random: np.random.Generator) -> dict[Any, Any]:
    """An action of each agent of the team, drawn uniformly from what is available."""
    found: dict[Any, Any] = {}
    for number, (agent, move) in enumerate(parallel.moves.items()):
        if isinstance(move, Choices):
            choices = np.flatnonzero(parallel.available()[number])
            found[agent] = move.action(int(random.choice(choices)))
        else:
            found[agent] = move.action(random.uniform(move.low, move.high))
    return found


def refuse_large(size: int, whose: str, config: EnvConfig) -> None:
    """Refuses what is too large for dense networks, or nothing.

    Raises:
        TaskError: saying what to do.
    """
    if size < 1:
        raise TaskError(f"{whose} has no entries; every agent needs something to see.")
    if size > config.largest_observation:
        raise TaskError(
            f"{whose} has {size:,} entries, and at most {config.largest_observation:,} are "
            "learned. Networks here are dense and every step is kept: make images smaller where "
            "the environment is made (docs/environments.md shows how, a tenth of the width and "
            "height is often enough), or raise --env.largest-observation and lower "
            "--learner.replay-capacity or --facmac.replay-capacity."
        )
