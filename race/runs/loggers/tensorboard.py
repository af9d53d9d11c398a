"""TensorBoard's event files, in ``DIR/tensorboard``."""

import secrets
from collections.abc import Sequence
from pathlib import Path
from typing import final

import imageio.v3 as iio

from race.runs.loggers.base import Logged, Point


@final
class TensorBoard:
    """A `race.runs.loggers.base.Logger`. A resumed run adds a file to its folder."""

    def __init__(self, run: Logged) -> None:
        from tensorboardX import SummaryWriter

        self._writer = SummaryWriter(
            logdir=str(run.path / "tensorboard"),
            # Files are named by the second: two sessions within one would be one file.
            filename_suffix=f".{secrets.token_hex(4)}",
        )
        if not run.kept.get("told"):
            told = {**run.tags, **run.settings}
            table = "\n".join(f"| {name} | {value} |" for name, value in told.items())
            self._writer.add_text("settings", f"| setting | value |\n|---|---|\n{table}")
            run.kept["told"] = True

    def send(self, points: Sequence[Point]) -> None:
        """See `Logger`."""
        for point in points:
            for name, value in point.values.items():
                self._writer.add_scalar(name, value, point.env_steps)
        self._writer.flush()

    def picture(self, name: str, file: Path, env_steps: int) -> None:
        """See `Logger`."""
        image = iio.imread(file)[..., :3]
        self._writer.add_image(name, image, env_steps, dataformats="HWC")

    def close(self, finished: bool) -> None:
        """See `Logger`."""
        self._writer.close()
