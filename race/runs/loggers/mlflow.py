"""MLflow: where it keeps runs is its own setting (``MLFLOW_TRACKING_URI``)."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import final

from race.runs.loggers.base import PROJECT, Logged, Point

_MOST_AT_ONCE = 1000, 100  # numbers, settings: what its servers take
_LONGEST = 500


@final
class MLflow:
    """A `race.runs.loggers.base.Logger`; its steps are environment steps."""

    def __init__(self, run: Logged) -> None:
        from mlflow.entities import Metric, Param
        from mlflow.tracking import MlflowClient

        self._metric, self._client = Metric, MlflowClient()
        if "id" not in run.kept:
            found = self._client.get_experiment_by_name(PROJECT)
            at = self._client.create_experiment(PROJECT) if found is None else found.experiment_id
            made = self._client.create_run(at, run_name=run.name, tags=run.tags)
            run.kept["id"] = made.info.run_id
            settings = [Param(k, str(v)[:_LONGEST]) for k, v in run.settings.items()]
            for begin in range(0, len(settings), _MOST_AT_ONCE[1]):
                some = settings[begin : begin + _MOST_AT_ONCE[1]]
                self._client.log_batch(run.kept["id"], params=some)
        self._id: str = run.kept["id"]
        self._client.update_run(self._id, status="RUNNING")

    def send(self, points: Sequence[Point]) -> None:
        """See `Logger`."""
        now = int(1000 * time.time())
        numbers = [
            self._metric(name, value, now, point.env_steps)
            for point in points
            for name, value in point.values.items()
        ]
        for begin in range(0, len(numbers), _MOST_AT_ONCE[0]):
            self._client.log_batch(self._id, metrics=numbers[begin : begin + _MOST_AT_ONCE[0]])

    def picture(self, name: str, file: Path, env_steps: int) -> None:
        """See `Logger`."""
        self._client.log_artifact(self._id, str(file))

    def close(self, finished: bool) -> None:
        """See `Logger`."""
        self._client.set_terminated(self._id, "FINISHED" if finished else "KILLED")
