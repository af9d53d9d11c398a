"""Base MARL methods: what a team and its critic are, and how targets are made.

A method is added as one more `Learner`; algorithms are written against that interface alone.
"""

from race.config.shape import Shape
from race.learners.base import Learner
from race.learners.facmac import facmac
from race.learners.facmac_continuous import facmac_continuous
from race.learners.maddpg import maddpg
from race.learners.matd3 import matd3

LEARNERS: dict[str, Learner] = {"matd3": matd3, "maddpg": maddpg, "facmac": facmac_continuous}
"""Those of continuous actions by name; on discrete ones there is `facmac`."""


def learner_of(shape: Shape) -> Learner:
    """The learner of a run."""
    return facmac if shape.discrete else LEARNERS[shape.base]


__all__ = ["LEARNERS", "Learner", "facmac", "facmac_continuous", "learner_of", "maddpg", "matd3"]
