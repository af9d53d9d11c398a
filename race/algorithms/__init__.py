"""Ways to train teams: with gradients alone, or with an evolving population beside them.

What happens to networks and heads in a generation is changed here, once for every learner.
"""

from race.algorithms.base import Algorithm
from race.algorithms.ea import ea
from race.algorithms.marl import marl
from race.algorithms.merl import merl
from race.algorithms.race import race
from race.config.settings import Config


def algorithm_of(config: Config) -> Algorithm:
    """The algorithm of a resolved configuration."""
    if not config.has_population:
        return marl
    if not config.has_marl:
        return ea
    return merl if config.whole_teams else race


__all__ = ["Algorithm", "algorithm_of", "ea", "marl", "merl", "race"]
