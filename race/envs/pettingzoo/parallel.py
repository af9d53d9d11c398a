"""A PettingZoo environment, every answer of which is checked, as its team sees it.

The interface is PettingZoo's parallel one: dictionaries by agent, of those that are there. An
agent is there while it is in ``env.agents`` and has not ended; it may leave and return.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple, final

import numpy as np
from gymnasium import spaces
from jaxtyping import Bool, Float32

from race.envs import contract
from race.envs.checked import takes
from race.envs.pettingzoo.vectors import MASK, Choices, Reach, Sight, is_continuous, moves
from race.errors import HandedOverError, TaskError
from race.types import LARGEST

_METHODS: Final = ("reset", "step", "observation_space", "action_space")
_SEVERAL: Final = (tuple, list)
_BY_AGENT: Final = (dict, Mapping)  # the first is what it almost always is, and told apart sooner

Other = Callable[[Any, Any, Any, np.random.Generator], Any]
"""``other(agent, observation, action_space, random) -> action`` of an agent outside the team."""


class End(NamedTuple):
    """Whether a step ended the episode of the team, and how."""

    terminated: bool
    truncated: bool


@final
class Parallel:
    """A parallel environment and those of its agents that are a team.

    Attributes:
        env: the environment.
        team: the team's agents, in the order of ``possible_agents``.
        others: the other agents.
        sights: how the observations of all agents become vectors.
        moves: how the agents of the team act.
        rewards: what each agent of the team was paid in the last step; 0 if it was not
            there.
        seeded: whether its reset takes a seed.
    """

    def __init__(
        self,
        env: Any,
        team: Callable[[list[Any]], list[Any]],
        other: Other | None,
        *,
        turns: bool = False,
    ) -> None:
        """Looks at an environment.

        Args:
            env: the environment.
            team: picks the team out of all agents.
            other: acts for the others; None: at random.
            turns: whether agents take turns, so that only the action of one of them counts: the
                environment is PettingZoo's ``turn_based_aec_to_parallel_wrapper``.

        Raises:
            TaskError: if it is none, or its agents observe or act as none can learn.
        """
        missing = [name for name in _METHODS if not callable(getattr(env, name, None))]
        if missing:
            raise TaskError(
                f"{contract.came(env)} is no PettingZoo environment: it has no "
                f"{', '.join(missing)}. Let make return a pettingzoo.ParallelEnv or AECEnv; a "
                "gymnasium environment becomes a task by race.envs.factorised."
            )
        possible = getattr(env, "possible_agents", None)
        if not isinstance(possible, list | tuple) or not possible:
            raise TaskError(
                f"{type(env).__name__}.possible_agents is {contract.came(possible)}, but must be a "
                "list of all agents that there may ever be: teams are of a fixed size."
            )
        self.env = env
        self.agents = list(possible)
        self.team = team(self.agents)
        self.others = [agent for agent in self.agents if agent not in self.team]
        self.sights = {
            agent: Sight(
                env.observation_space(agent),
                f"the observation of {agent}",
                masked=not is_continuous(env.action_space(agent)),
            )
            for agent in self.agents
        }
        self.moves: dict[Any, Reach | Choices] = {
            agent: moves(env.action_space(agent), f"the action space of {agent}")
            for agent in self.team
        }
        kinds = {agent: type(move) for agent, move in self.moves.items()}
        if len(set(kinds.values())) > 1:
            numbers = [str(agent) for agent, kind in kinds.items() if kind is Reach]
            choose = [str(agent) for agent, kind in kinds.items() if kind is Choices]
            raise TaskError(
                f"{', '.join(numbers)} act by numbers and {', '.join(choose)} by choices; a team "
                "learns one or the other. Pick agents of one kind with --env.agents."
            )
        self.seeded = takes(env.reset, seed=0)
        self.rewards = [0.0] * len(self.team)
        self._other, self._turns = other, turns
        self._known = frozenset(self.agents)
        self._nothing = {a: np.zeros(sight.size, np.float32) for a, sight in self.sights.items()}
        counts = [move.count for move in self.moves.values() if isinstance(move, Choices)]
        self._all_choices = np.arange(max(counts, default=0)) < np.array(counts)[:, None]
        self._other_spaces: dict[Any, Any] = {}
        self._random = np.random.default_rng(0)
        self._observations: Mapping[Any, Any] = {}
        self._infos: Mapping[Any, Any] = {}
        self._present: set[Any] = set()
        self._choosing: set[Any] = set()

    def reset(self, seed: int | None) -> None:
        """Begins an episode.

        Raises:
            HandedOverError: if what the environment shows breaks its interface.
        """
        self._random = np.random.default_rng(seed)
        self._other_spaces = {agent: self.env.action_space(agent) for agent in self.others}
        for space in self._other_spaces.values():
            space.seed(int(self._random.integers(2**31)))
        answer = self.env.reset(seed=seed) if self.seeded and seed is not None else self.env.reset()
        if not _are_dictionaries(answer, 2):
            raise HandedOverError(
                f"reset returned {contract.came(answer)} instead of the pair (observations, infos) "
                "of dictionaries by agent. Let it end with `return observations, infos`"
            )
        self._observations, self._infos = answer
        self._present = set(self._living())
        self._choosing = set(self._present)
        if not self._present & set(self.team):
            raise HandedOverError(
                f"no agent of the team ({_listed(self.team)}) is in agents after reset, only "
                f"{_listed(self._living()) or 'nobody'}. Let reset set self.agents"
            )
        self._refuse_unseen()

    def step(self, actions: Mapping[Any, Any]) -> End:
        """A step.

        Args:
            actions: of the team's agents; those of agents that are not there go nowhere.

        Raises:
            HandedOverError: if what the environment answers breaks its interface.
        """
        before = self._present
        given = {a: actions[a] for a in self.team if a in before}
        for agent in self.others:
            if agent in before:
                given[agent] = self._other_action(agent)
        answer = self.env.step(given)
        if not _are_dictionaries(answer, 5):
            raise HandedOverError(
                f"step returned {contract.came(answer)} instead of five dictionaries by agent: "
                "observations, rewards, terminations, truncations, infos"
            )
        self._observations, rewards, terminations, truncations, self._infos = answer
        self.rewards = [
            contract.payment(_of(rewards, agent, "reward"), str(agent)) if agent in before else 0.0
            for agent in self.team
        ]
        ended, cut = set(), set()
        for agent in before:
            terminated = _flag(terminations, agent, "termination")
            truncated = _flag(truncations, agent, "truncation")
            if terminated or truncated:
                ended.add(agent)
                if not terminated:
                    cut.add(agent)
        self._present = set(self._living()) - ended
        self._refuse_unseen()
        self._choosing = self._present | (cut & set(self._observations)) if cut else self._present
        if any(agent in self._present for agent in self.team):
            return End(terminated=False, truncated=False)
        return self._end(before, ended, cut)

    def seen(
        self, agents: Sequence[Any]
    ) -> tuple[list[Float32[np.ndarray, "_"]], Float32[np.ndarray, "_"]]:
        """What some agents observe, to be read at once, and all of it one after the other, a copy.

        It is zeros for those that are not there.

        Raises:
            HandedOverError: if it is not of an agent's space.
        """
        found = []
        for agent in agents:
            if agent in self._observations:
                found.append(self.sights[agent].quick(self._observations[agent]))
            else:
                found.append(self._nothing[agent])
        joint = np.concatenate(found)
        with np.errstate(all="ignore"):
            fine = joint.dot(joint) <= LARGEST**2
        if not fine:  # the slow way says whose, and which
            for agent in agents:
                if agent in self._observations:
                    self.sights[agent](self._observations[agent])
        return found, joint

    def available(self) -> Bool[np.ndarray, "N A"]:
        """Which choices the agents of the team have, padded: the first alone of one not there.

        An agent that was cut off keeps its choices at that moment, through which learning
        bootstraps.

        Raises:
            HandedOverError: if a mask is none.
        """
        found = self._all_choices.copy()
        for number, agent in enumerate(self.team):
            if agent not in self._choosing or not self._has_turn(agent):
                found[number] = False
                found[number, 0] = True
                continue
            mask = self._mask(agent)
            if mask is not None:
                move = self.moves[agent]
                assert isinstance(move, Choices)
                found[number, : move.count] = move.available(mask)
        return found

    def _end(self, before: set[Any], ended: set[Any], cut: set[Any]) -> End:
        last = [agent for agent in self.team if agent in before]
        if not any(agent in ended for agent in last):
            raise HandedOverError(
                f"no agent of the team is left, but neither terminations nor truncations say so of "
                f"{_listed(last)}. Let one of them be True where an agent leaves for good"
            )
        truncated = any(agent in cut for agent in last)
        return End(not truncated, truncated)

    def _living(self) -> list[Any]:
        living = getattr(self.env, "agents", None)
        if not isinstance(living, list | tuple):
            raise HandedOverError(
                f"agents is {contract.came(living)}, but must be the list of the agents that are "
                "there, from reset on"
            )
        if not self._known.issuperset(living):
            strange = [agent for agent in living if agent not in self._known]
            raise HandedOverError(
                f"agents has {_listed(strange)}, not one of possible_agents. Let possible_agents "
                "name all that may ever come"
            )
        return list(living)

    def _refuse_unseen(self) -> None:
        for agent in self.team:
            if agent in self._present and agent not in self._observations:
                raise HandedOverError(
                    f"{agent} is among agents, but the observations have none of it, only "
                    f"{_listed(self._observations) or 'nothing'}"
                )

    def _has_turn(self, agent: Any) -> bool:
        """Whether what an agent does counts: where they take turns, that of one alone."""
        return not self._turns or agent == self.env.aec_env.agent_selection

    def _mask(self, agent: Any) -> Any:
        if self.sights[agent].has_mask:
            observation = self._observations[agent]
            if not isinstance(observation, Mapping) or MASK not in observation:
                raise HandedOverError(
                    f"the observation of {agent} is {contract.came(observation)} and has no "
                    f"{MASK}, which its space has"
                )
            return observation[MASK]
        info = self._infos.get(agent)
        return info.get(MASK) if isinstance(info, Mapping) else None

    def _other_action(self, agent: Any) -> Any:
        space = self._other_spaces[agent]
        if self._other is not None:
            return self._other(agent, self._observations.get(agent), space, self._random)
        mask = self._mask(agent)
        if mask is None or not isinstance(space, spaces.Discrete):
            return space.sample()
        return space.sample(np.asarray(mask, np.int8))


def _are_dictionaries(answer: Any, count: int) -> bool:
    return (
        isinstance(answer, _SEVERAL)
        and len(answer) == count
        and all(isinstance(part, _BY_AGENT) for part in answer)
    )


def _flag(flags: Mapping[Any, Any], agent: Any, what: str) -> bool:
    value = flags.get(agent)
    if value is True or value is False:  # as almost always, and this is called often
        return value
    return contract.truth(_of(flags, agent, what), f"the {what}", str(agent))


def _of(answers: Mapping[Any, Any], agent: Any, what: str) -> Any:
    if agent not in answers:
        raise HandedOverError(
            f"there is no {what} of {agent}, which was there before the step, only of "
            f"{_listed(answers) or 'nobody'}"
        )
    return answers[agent]


def _listed(names: Any, most: int = 8) -> str:
    texts = [str(name) for name in names]
    more = f" and {len(texts) - most} more" if len(texts) > most else ""
    return ", ".join(texts[:most]) + more
