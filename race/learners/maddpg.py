"""MADDPG: MATD3 with a single critic.

`race.config.presets.resolve` sets the policy delay to 1, and target actions are not smoothed, which
takes the other two of TD3's additions away.
"""

from jaxtyping import Array, Float, PRNGKeyArray

from race.config.hyper import Hyper
from race.config.shape import Shape
from race.learners.matd3 import critics_of, matd3, pevfas_of
from race.networks.critics import Critic, Pevfa
from race.networks.dense import act
from race.types import EnvSpec


def new_critic(key: PRNGKeyArray, spec: EnvSpec, shape: Shape) -> Critic:
    """A fresh critic, an ensemble of one."""
    return critics_of(key, spec, shape, 1)


def new_pevfa(key: PRNGKeyArray, spec: EnvSpec, shape: Shape) -> Pevfa:
    """A fresh PeVFA, an ensemble of one."""
    return pevfas_of(key, spec, shape, 1)


def target_action(
    z: Float[Array, "N B H"],
    head: Float[Array, "N H1 A"],
    state: Float[Array, "B S"],
    key: PRNGKeyArray,
    spec: EnvSpec,
    hyper: Hyper,
) -> Float[Array, "B U"]:
    """The policies' actions."""
    return act(z, head, spec)


maddpg = matd3._replace(init_critic=new_critic, init_pevfa=new_pevfa, target_action=target_action)
"""MADDPG (Lowe et al. 2017) with one team reward and one central critic."""
