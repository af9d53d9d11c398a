"""Weights & Biases: where it sends runs, or keeps them, is its own setting (``WANDB_MODE``)."""

import secrets
from collections.abc import Sequence
from pathlib import Path
from typing import final

from race.runs.loggers.base import PROJECT, Logged, Point


@final
class Wandb:
    """A `race.runs.loggers.base.Logger`; its steps are environment steps."""

    def __init__(self, run: Logged) -> None:
        import wandb

        run.kept.setdefault("id", secrets.token_hex(4))
        self._library = wandb
        self._run = wandb.init(
            project=PROJECT,
            name=run.name,
            id=run.kept["id"],
            resume="allow",
            group=run.tags["cohort"],
            tags=[f"{key}: {value}"[:64] for key, value in run.tags.items()],
            config={**run.settings, "method": run.tags["method"]},
            dir=str(run.path),
            # Runs of a cohort are in one process.
            reinit="create_new",
            settings=wandb.Settings(console="off", silent=True),
        )

    def send(self, points: Sequence[Point]) -> None:
        """See `Logger`."""
        for point in points:
            self._run.log(point.values, step=point.env_steps)

    def picture(self, name: str, file: Path, env_steps: int) -> None:
        """See `Logger`."""
        self._run.log({name: self._library.Image(str(file))}, step=env_steps)

    def close(self, finished: bool) -> None:
        """See `Logger`."""
        self._run.finish()
