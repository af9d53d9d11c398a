"""Teams and places are drawn by generators of their own, by `random` and by numpy's."""

import random
from typing import Any

import numpy as np
from smac.env import StarCraft2Env


class _Places:
    def __init__(self) -> None:
        self.rng = np.random.default_rng()

    def generate(self) -> list[float]:
        return [self.rng.uniform(), random.random(), np.random.rand()]  # noqa: NPY002


class _Either:
    def __init__(self) -> None:
        self.one, self.rng = _Places(), np.random.default_rng()

    def generate(self) -> list[float]:
        return [*self.one.generate(), self.rng.uniform()]


class StarCraftCapabilityEnvWrapper:
    def __init__(self, **kwargs: Any) -> None:
        self.given = kwargs
        kwargs["capability_config"]["team_gen"]["n_units"] = 1  # as SMACv2 does, in place
        self.env_key_to_distribution_map = {"start_positions": _Either()}
        self.env = StarCraft2Env("2s3z", seed=kwargs.get("seed"))
        self.drawn = [0.0] * 4

    def reset(self) -> None:
        self.drawn = self.env_key_to_distribution_map["start_positions"].generate()
        self.env.reset()

    def get_state(self) -> np.ndarray:
        return np.array(self.drawn, np.float32)

    def get_state_feature_names(self) -> list[str]:
        return ["a", "b", "c", "d"]

    def get_obs_feature_names(self) -> list[str]:
        config = self.given["capability_config"]
        return [f"{config['n_units']} against {config['n_enemies']}", self.given["map_name"], "x"]

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)
