"""Whether what one agent of a team is paid for costs another: told, since then it is no team."""

import contextlib
import time
from typing import Any, Final, NamedTuple, Protocol, runtime_checkable

import numpy as np
from gymnasium import spaces
from jaxtyping import Float

from race.envs.checked import CheckedEnv
from race.errors import EnvFailedError

_STEPS: Final = 2000
_SECONDS: Final = 4.0  # of slow environments fewer steps are looked at
_FEWEST: Final = 50
_AGAINST: Final = 0.1
_DOUBT: Final = 3.0
"""Two agents are taken to be against each other if the correlation of their rewards in n steps is
below ``-(_AGAINST + _DOUBT / sqrt(n))``.

Measured in 2000 steps: -0.24 to -0.81 in the tasks of mpe2 with adversaries, and above -0.04 in all
others of mpe2, SISL and butterfly that were tried.
"""


class Conflict(NamedTuple):
    """Two agents whose rewards went against each other."""

    one: str
    other: str
    correlation: float


@runtime_checkable
class Paying(Protocol):
    """An environment that tells what each agent of its team was paid."""

    action_space: Any

    @property
    def team_names(self) -> Any:
        """Names of the team's agents."""
        ...

    @property
    def team_paid(self) -> Any:
        """What each of them was paid in the newest step."""
        ...


def look(env: CheckedEnv) -> Conflict | None:
    """Plays at random and compares what the agents of a team are paid.

    An environment that fails meanwhile is looked at no further: whether that ends a run is decided
    in training.

    Args:
        env: the environment; one whose agents' rewards are not known is not looked at.

    Raises:
        HandedOverError: if what it shows breaks the contract.
    """
    team = env.env
    if not isinstance(team, Paying) or len(team.team_names) < 2:
        return None
    found = opposed(_rewards(env, team))
    if found is None:
        return None
    one, other, correlation = found
    return Conflict(str(team.team_names[one]), str(team.team_names[other]), correlation)


def opposed(rewards: Float[np.ndarray, "steps N"]) -> tuple[int, int, float] | None:
    """The two agents whose rewards are most against each other; None if none are.

    Args:
        rewards: of the agents, in many steps.
    """
    varied = np.flatnonzero(rewards.std(axis=0) > 0)
    if len(rewards) < _FEWEST or len(varied) < 2:
        return None
    correlation = np.corrcoef(rewards[:, varied], rowvar=False)
    one, other = np.unravel_index(correlation.argmin(), correlation.shape)
    lowest = float(correlation[one, other])
    if lowest > -(_AGAINST + _DOUBT / len(rewards) ** 0.5):
        return None
    first, second = sorted((int(varied[one]), int(varied[other])))
    return first, second, lowest


def _rewards(env: CheckedEnv, team: Paying) -> Float[np.ndarray, "steps N"]:
    random = np.random.default_rng(0)
    found: list[list[float]] = []
    began, episode, over = time.monotonic(), 0, True
    seen: Any = None
    with contextlib.suppress(EnvFailedError):
        while len(found) < _STEPS and time.monotonic() - began < _SECONDS:
            if over:
                seen = env.reset(episode)
                episode += 1
            if isinstance(team.action_space, spaces.Box):
                units = random.uniform(team.action_space.low, team.action_space.high)
                step = env.step(units.astype(np.float32))
            else:
                rows = seen.avail_actions
                step = env.step(np.array([random.choice(np.flatnonzero(row)) for row in rows]))
            seen, over = step.seen, step.terminated or step.truncated
            found.append(list(team.team_paid))
    return np.array(found).reshape(len(found), len(team.team_names))
