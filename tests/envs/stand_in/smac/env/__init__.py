"""A game of numbers with the interface of SMAC's environment. Its "game" is a process that sleeps.

An agent's actions are: nothing, once it is dead; stop; four ways to go; and one for each enemy.
Attacking enemy 0 with all agents wins. Agent 1 is dead from the second step on.
"""

import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np

from smac.env.starcraft2.maps.smac_maps import get_smac_map_registry

if os.environ.get("STAND_IN") == "protobuf":
    raise TypeError("Descriptors cannot be created directly.")


class StarCraft2Env:
    def __init__(
        self,
        map_name: str = "8m",
        seed: int | None = None,
        difficulty: str = "7",
        game_version: str | None = None,
        continuing_episode: bool = False,
    ) -> None:
        sizes = get_smac_map_registry()[map_name]
        self.n_agents, self.n_enemies = sizes["n_agents"], sizes["n_enemies"]
        self.episode_limit, self.continuing_episode = sizes["limit"], continuing_episode
        self.n_actions = 6 + self.n_enemies
        self._seed, self._episode, self._steps = seed, 0, 0
        self._game: subprocess.Popen[bytes] | None = None

    def get_env_info(self) -> dict[str, Any]:
        return {
            "n_agents": np.int64(self.n_agents),
            "n_actions": self.n_actions,
            "obs_shape": 3,
            "state_shape": 4,
            "episode_limit": self.episode_limit,
            "agent_features": ["health"],
        }

    def seed(self) -> int | None:
        return self._seed

    def reset(self) -> None:
        if self._game is None:
            print("the game talks on standard output")
            self._game = subprocess.Popen(["sleep", "600"])
        self._episode, self._steps = self._episode + 1, 0

    def full_restart(self) -> None:
        raise AssertionError("the battle would be counted as lost")

    def step(self, actions: list[int]) -> tuple[float, bool, dict[str, Any]]:
        available = self.get_avail_actions()
        assert all(row[action] for row, action in zip(available, actions, strict=True))
        assert all(type(action) is int for action in actions)
        self._steps += 1
        trouble = Path(os.environ.get("STAND_IN_TROUBLE", os.devnull))
        kind = trouble.read_text() if self._steps == 2 else ""
        if kind:
            trouble.write_text("")  # the next battle goes well
        if kind == "dies":
            try:
                raise ConnectionError("websocket closed")
            except ConnectionError:
                self.full_restart()
                return 0, True, {}
        if kind == "exits":
            os._exit(7)
        won = self._steps == 1 and all(action == 6 for action in actions)
        limited = self._steps >= self.episode_limit
        facts: dict[str, Any] = {"battle_won": won, "dead_allies": 0}
        if limited and self.continuing_episode:
            facts["episode_limit"] = True
        return np.float64(self._steps + 20 * won), won or limited, facts

    def get_obs(self) -> list[np.ndarray]:
        seen = (self._seed or 0, self._episode, self._steps)
        return [np.array(seen, np.float32) + agent for agent in range(self.n_agents)]

    def get_state(self) -> np.ndarray:
        return np.array([self._game.pid if self._game else 0, os.getpid(), 1, 2], np.float32)

    def get_avail_actions(self) -> list[list[int]]:
        dead = [1] + [0] * (self.n_actions - 1)
        alive = [0] + [1] * (self.n_actions - 1)
        gone = self._steps >= 1
        return [dead if agent == 1 and gone else alive for agent in range(self.n_agents)]

    def close(self) -> None:
        if self._game is not None and os.environ.get("STAND_IN") != "leaves the game":
            self._game.kill()
            self._game.wait()
