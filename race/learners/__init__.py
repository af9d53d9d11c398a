"""Base MARL methods: what a team and its critic are, and how targets are made.

A method is added as one more `Learner`; algorithms are written against that interface alone.
"""

from race.config.settings import Config
from race.learners.base import Learner
from race.learners.facmac import facmac
from race.learners.facmac_continuous import facmac_continuous
from race.learners.maddpg import maddpg
from race.learners.matd3 import matd3

LEARNERS: dict[str, Learner] = {"matd3": matd3, "maddpg": maddpg, "facmac": facmac_continuous}
"""Those of continuous actions by name; on discrete ones there is `facmac`."""


def learner_of(config: Config) -> Learner:
    """The learner of a resolved configuration."""
    assert config.base is not None
    return facmac if config.discrete else LEARNERS[config.base]


__all__ = ["LEARNERS", "Learner", "facmac", "facmac_continuous", "learner_of", "maddpg", "matd3"]
