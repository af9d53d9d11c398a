"""The numbers in the rules of the probes, for host and device alike."""

from typing import Final

WINS: Final = ("probe/memory",)
"""Probes that can be won."""
MATCHING_ACTIONS: Final = 4
"""Actions, and thus cues, of ``probe/matching``."""
MEMORY_STEPS: Final = 3
"""Steps of ``probe/memory``."""
MEMORY_WAIT: Final = 1
"""The moment of ``probe/memory`` at which only action 0 is available."""
CLIMB_PAYOFFS: Final = ((1.0, -1.0, -0.25), (-1.0, 0.0, 0.25), (0.0, 0.25, 0.5))
"""Reward of ``probe/climb``; rows are the first agent's actions, columns the second's.

Best are both 0. Both 2 are safe: no agent gains by leaving alone, and 2 is the best choice against
a partner that plays at random.
"""
LIVES_AGENTS: Final = 3
"""Agents of ``probe/lives``; agent i lives for its first i + 1 steps."""
LIVES_STEPS: Final = (3, 5)
"""Fewest and most steps of ``probe/lives``."""
