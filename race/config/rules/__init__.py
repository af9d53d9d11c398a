"""What the values of settings must be, for each part of a configuration.

`race.config.checks` refuses what breaks one. What has no effect is in `race.config.effects`.
"""

from typing import Any

LARGEST_LAYER = 16_384
"""Units of a layer, samples of a batch, teams: more is a slip of the hand."""
MOST_TRANSITIONS = 2**30
"""Transitions in a replay buffer, which counts them with 32 bits."""

Rule = tuple[bool, str, Any, str]
"""Whether it holds, the setting, its value, and what it must be."""
