"""What a new run is handed of another one's teams, before its directory is made and after."""

from pathlib import Path
from typing import Any, NamedTuple

from race.algorithms.inheriting import Inherited
from race.config.settings import Config
from race.method.normalisation import Observed
from race.teams.trained import load_trained
from race.training.inheriting import made_to_fit, observed_to_fit, store
from race.types import AnyTask


class InitialTeams(NamedTuple):
    """The teams that a run begins with; None: random ones."""

    teams: Inherited | None
    told: dict[str, Any]
    observed: Observed | None = None

    def keep_in(self, path: Path) -> None:
        """Keeps them in a run directory that has just been made.

        Raises:
            CheckpointError: if they cannot be written.
        """
        if self.teams is not None:
            store(path, self.teams, self.told, self.observed)


def initial_teams(config: Config, task: AnyTask) -> InitialTeams:
    """What ``init_from`` of a configuration names, made to fit.

    Raises:
        ConfigError: if it does not fit.
        RunDirectoryError: if there is no such run, or it has no checkpoint yet.
    """
    if config.init_from is None:
        return InitialTeams(None, {})
    source = load_trained(config.init_from)
    teams = made_to_fit(
        source.encoders, source.heads, source.config, source.path, config, task.spec
    )
    told = {
        "from": str(source.path),
        "from_run": source.identity,
        "from_task": source.config.task,
        "from_env_steps": source.progress.env_steps,
    }
    observed = observed_to_fit(source.observed, source.path, task.spec)
    return InitialTeams(teams, told, observed)
