"""What recurrent networks see of a minibatch of episodes."""

from typing import NamedTuple

from jaxtyping import Array, Bool, Float, Int


class Moments(NamedTuple):
    """What the networks see of the slots of a minibatch."""

    obs: Float[Array, "L R N O"]
    last_action: Int[Array, "L R N"]  # -1 before the first step
    avail_actions: Bool[Array, "L R N A"]
    state: Float[Array, "L R S"]
    first: Bool[Array, "L R"]  # an episode begins here
    real: Float[Array, "L R"]  # 0 where no step was made, or in `later` where there is no moment
    moment: Int[Array, "L R"]  # chance depends on it, so that the layout has no say
