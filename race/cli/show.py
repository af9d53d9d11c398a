"""``race show``."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from race.cli import streams


@dataclass(frozen=True)
class Show:
    """Show what a run is and how far it is, from its files alone.

    No code of the run's task is imported or run, and nothing is written: this is how to look at the
    directory of somebody else before `race evaluate`, `race render` or `race resume` run the module
    of its task.
    """

    run_dir: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """The run's directory."""
    rows: int = 2
    """How many of the last rows of metrics to show."""
    json: bool = False
    """Print one JSON object with everything."""


def main(arguments: list[str]) -> None:
    """Parses the arguments, reads and prints."""
    chosen = tyro.cli(Show, args=arguments, prog="race show")
    from race.config.saved import to_json
    from race.envs.own import is_own
    from race.errors import ConfigError, command
    from race.runs import checkpoints
    from race.runs import directory as run_directory
    from race.runs.directory import RunDirectory
    from race.runs.results import of_directory
    from race.training.keeping import kept_teams

    if not 0 <= chosen.rows <= 1000:
        raise ConfigError(f"--rows is {chosen.rows}, but it must be from 0 to 1000.")
    found = of_directory(chosen.run_dir)
    config, origin = found.config, found.metadata
    saved = checkpoints.list_checkpoints(RunDirectory(chosen.run_dir).checkpoints)
    best = [kept.name for kept in kept_teams(chosen.run_dir)]
    shown: dict[str, Any] = {
        "run": run_directory.identity_of(chosen.run_dir),
        "task": config.task,
        "method": config.method,
        "seed": config.seed,
        "finished": run_directory.is_finished(chosen.run_dir),
        "checkpoints": [path.name for path in saved],
        "best": best,
        "config": to_json(config),
        "metadata": origin,
        "rows": found.rows[len(found.rows) - min(chosen.rows, len(found.rows)) :],
    }
    if chosen.json:
        print(json.dumps(shown, indent=2))
        return
    console = streams.console()
    told = found.rows[-1].get("env_steps") if found.rows else None
    steps = told if type(told) is int else 0
    state = "finished" if shown["finished"] else "not finished"
    lines = [
        f"{config.method} on {config.task}, seed {config.seed}",
        f"{state}, {steps:,} of {config.env_steps:,} environment steps in the metrics",
        f"checkpoints: {', '.join(shown['checkpoints']) or 'none'}",
        *([f"best tested teams, best first: {', '.join(best)}"] if best else []),
        f"identity: {shown['run'] or 'none (of an older version)'}",
        f"begun: {origin.get('started')}, race {origin.get('race')}, algorithm "
        f"{found.algorithm_version}, Python {origin.get('python')}, {origin.get('processor')}",
        f"command: {command(*_words(origin.get('command')))}",
        "settings: " + json.dumps(shown["config"]),
        "versions: " + json.dumps(origin.get("versions", {})),
        "task: " + json.dumps(origin.get("environment", {})),
    ]
    if is_own(config.task):
        module = config.task.partition(":")[0]
        lines.append(
            f"evaluate, render and resume import the module {module} from the current directory or "
            "the installed packages, and run it"
        )
    lines += ["last rows:"] + [json.dumps(row) for row in shown["rows"]]
    for line in lines:
        console.print(_plain(line), soft_wrap=True)


def _plain(line: str) -> str:
    """Without what would steer a terminal: the directory may be somebody else's."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in line)


def _words(said: Any) -> list[str]:
    return [str(word) for word in said] if isinstance(said, list) else []
