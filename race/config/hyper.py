"""`Hyper`: every number that the compiled programs take as an argument."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from race.config.settings import Config

Number = float | Float[Any, ""]


class Hyper(NamedTuple):
    """Numbers of the method and the learner, each a float32 scalar.

    Runs that differ in these alone share one program, and can be rows of one array. What a learner
    has no use for is NaN, so that a use of it would show.
    """

    actor_learning_rate: Number
    encoder_learning_rate: Number
    critic_learning_rate: Number
    gradient_clip: Number
    discount: Number
    """gamma"""
    target_update_rate: Number
    """tau; on discrete actions targets are copied instead (`Shape.target_update_every`)."""
    smoothing_noise: Number
    smoothing_clip: Number
    td_lambda: Number
    """lambda of FACMAC's targets on discrete actions."""
    last_layer_scale: Number
    own_share: Number
    """Of a minibatch; NaN where it is what the buffer holds."""
    mutation_fraction: Number
    """alpha"""
    mutation_probability: Number
    agent_mutation_probability: Number
    crossover_probability: Number
    injection_probability: Number
    strong_share: Number
    reset_share: Number
    strong_strength: Number
    mild_strength: Number
    largest_weight: Number
    """Infinite where there is no bound."""
    cem_elite_share: Number
    cem_noise_start: Number
    cem_noise_end: Number
    cem_noise_decay: Number
    es_noise: Number
    es_learning_rate: Number
    vmm_weight: Number
    """beta, the weight of Eq. (5) in Eq. (6)."""
    vfm_marl_weight: Number
    vfm_team_weight: Number
    """Weights of the two terms of Eq. (2)."""
    head_learning_rate: Number
    """Of the population's heads; 0 where evolution alone changes them (`Shape.heads_learn`)."""
    value_awareness: Number
    """1: Eq. (5) with its weights; 0: with all weights 1."""


_OF_GRADIENTS = (
    *("actor_learning_rate", "encoder_learning_rate", "critic_learning_rate", "gradient_clip"),
    *("discount", "target_update_rate", "smoothing_noise", "smoothing_clip", "td_lambda"),
    "last_layer_scale",
)
NUMBERS_OF_EVOLUTIONS = {
    "ga": (
        *("mutation_fraction", "mutation_probability", "agent_mutation_probability"),
        *("crossover_probability", "strong_share", "reset_share", "strong_strength"),
        *("mild_strength", "largest_weight"),
    ),
    "cem": ("cem_elite_share", "cem_noise_start", "cem_noise_end", "cem_noise_decay"),
    "es": ("es_noise", "es_learning_rate"),
}


def hyper_of(config: Config) -> Hyper:
    """The numbers of a run of a resolved configuration."""
    learner, facmac, race = config.learner, config.facmac, config.race
    unused = float("nan")
    numbers = {
        "target_update_rate": unused if config.discrete else learner.target_update_rate,
        "smoothing_noise": learner.smoothing_noise if config.base == "matd3" else unused,
        "smoothing_clip": learner.smoothing_clip if config.base == "matd3" else unused,
        "td_lambda": facmac.td_lambda if config.discrete else unused,
    }
    shared: Any = facmac if config.discrete else learner
    numbers["encoder_learning_rate"] = shared.encoder_learning_rate or shared.actor_learning_rate
    for name in (
        *("actor_learning_rate", "critic_learning_rate", "gradient_clip", "discount"),
        "last_layer_scale",
    ):
        numbers[name] = getattr(shared, name)
    for name in set(Hyper._fields) - set(numbers):  # the rest is the population's
        numbers[name] = getattr(race, name) if config.has_population else unused
    idle = set()
    if config.whole_teams:
        idle |= {"vmm_weight", "vfm_marl_weight", "vfm_team_weight", "value_awareness"}
        idle.add("head_learning_rate")
    if not config.has_marl:
        idle |= {"injection_probability", "own_share", *_OF_GRADIENTS}
    if config.has_population:
        used = NUMBERS_OF_EVOLUTIONS.get(race.evolution, ())
        idle |= {name for of in NUMBERS_OF_EVOLUTIONS.values() for name in of if name not in used}
    if race.own_share is None:
        idle.add("own_share")
    if config.one_head:
        numbers["agent_mutation_probability"] = 1.0  # of a mutating team's only head
    numbers |= dict.fromkeys(idle, unused)
    if numbers["largest_weight"] is None:
        numbers["largest_weight"] = float("inf")
    return Hyper(**{name: np.float32(number) for name, number in numbers.items()})
