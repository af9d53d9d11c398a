"""Programs that can be told of a run besides its own metrics."""

from typing import Literal

LoggerName = Literal["tensorboard", "wandb", "mlflow", "trackio"]
