"""MADDPG: MATD3 with a single critic.

`race.config.presets.resolve` sets the policy delay to 1 and the smoothing noise to 0 for it, which
takes the other two of TD3's additions away.
"""

from jaxtyping import PRNGKeyArray

from race.config.settings import Config
from race.learners.matd3 import critics_of, matd3, pevfas_of
from race.networks.critics import Critic, Pevfa
from race.types import EnvSpec


def new_critic(key: PRNGKeyArray, spec: EnvSpec, config: Config) -> Critic:
    """A fresh critic, an ensemble of one."""
    return critics_of(key, spec, config, 1)


def new_pevfa(key: PRNGKeyArray, spec: EnvSpec, config: Config) -> Pevfa:
    """A fresh PeVFA, an ensemble of one."""
    return pevfas_of(key, spec, config, 1)


maddpg = matd3._replace(init_critic=new_critic, init_pevfa=new_pevfa)
"""MADDPG (Lowe et al. 2017) with one team reward and one central critic."""
