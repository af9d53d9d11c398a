"""Base MARL methods: what a team and its critic are, and how targets are made."""

from race.learners.base import Learner
from race.learners.maddpg import maddpg
from race.learners.matd3 import matd3

LEARNERS: dict[str, Learner] = {"matd3": matd3, "maddpg": maddpg}

__all__ = ["LEARNERS", "Learner", "maddpg", "matd3"]
