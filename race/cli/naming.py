"""How commands speak of what a run holds."""

from typing import Any

import tyro

CHECKPOINT: Any = tyro.conf.arg(metavar="NAME", help_behavior_hint="(default: the newest)")
