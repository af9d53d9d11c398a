"""What pictures tell of the moments before: who died, struck or was hit a short while ago."""

from typing import Final, NamedTuple, final

import numpy as np
from jaxtyping import Bool, Int

from race.envs.micro.scenario import Scenario
from race.envs.micro.state import Units

LONG_AGO: Final = 1000
"""Loops after which it does not matter any more how many."""


class Moment(NamedTuple):
    """The units after a game loop, as numpy arrays, and loops since things befell each."""

    units: Units
    since_death: Int[np.ndarray, "U"]
    since_strike: Int[np.ndarray, "U"]
    since_hit: Int[np.ndarray, "U"]
    """Since it lost health or shield."""
    heals: Bool[np.ndarray, "U"]
    """Whether it spent energy in this loop."""


@final
class Watch:
    """Sees a battle loop by loop."""

    def __init__(self, scenario: Scenario) -> None:
        """A watch over battles of a map whose arrays are numpy's."""
        self._second_hit = scenario.second_hit
        self.forget()

    def forget(self) -> None:
        """Before another battle."""
        self._moment: Moment | None = None

    @property
    def moment(self) -> Moment:
        """What was seen last.

        Raises:
            ValueError: if nothing was seen.
        """
        if self._moment is None:
            raise ValueError("Nothing of this battle was seen yet.")
        return self._moment

    def see(self, units: Units) -> None:
        """The units after one more game loop, as numpy arrays."""
        if self._moment is None:
            never = np.full(len(units.x), LONG_AGO)
            self._moment = Moment(units, never, never, never, units.health < 0)
            return
        last, before = self._moment, self._moment.units
        died = (before.health > 0) & (units.health <= 0)
        second = (self._second_hit > 0) & (before.pending > 0) & (units.pending <= 0)
        struck = (units.cooldown > before.cooldown) | second
        hit = units.health + units.shield < before.health + before.shield - 1e-3
        self._moment = Moment(
            units,
            since_death=_since(died, last.since_death),
            since_strike=_since(struck, last.since_strike),
            since_hit=_since(hit, last.since_hit),
            heals=units.energy < before.energy,
        )


def _since(now: Bool[np.ndarray, "U"], loops: Int[np.ndarray, "U"]) -> Int[np.ndarray, "U"]:
    return np.where(now, 0, np.minimum(loops + 1, LONG_AGO))
