"""Ways to train teams: with gradients alone, or with an evolving population beside them.

What happens to networks and heads in a generation is changed here, once for every learner.
"""

from race.algorithms.base import Algorithm
from race.algorithms.marl import marl
from race.algorithms.race import race
from race.config.settings import Config


def algorithm_of(config: Config) -> Algorithm:
    """The algorithm of a resolved configuration."""
    return race if config.has_population else marl


__all__ = ["Algorithm", "algorithm_of", "marl", "race"]
