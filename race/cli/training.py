"""What ``race train`` and ``race resume`` share: the run itself, with its display."""

import sys
from pathlib import Path

from rich.console import Console

from race.cli import seconds_since_start, streams
from race.compilation import use_cache
from race.config.settings import Config
from race.envs import has_no_picture
from race.errors import command, say
from race.training.trainer import is_over, train
from race.viewing.logged import logged
from race.viewing.progress import TrainingDisplay


def run(path: Path, config: Config, *, extend: bool = False, without_metrics: bool = False) -> None:
    """Trains in an existing run directory and says how it ended. Exits with 130 on Ctrl-C."""
    import time

    use_cache(config.compute)
    console = streams.console(tolerant=True)
    console.print(
        f"{config.method} on {config.task}, seed {config.seed}, in {path}", soft_wrap=True
    )
    began = time.perf_counter() - seconds_since_start()
    with (
        TrainingDisplay(config, console) as display,
        logged(path, config, display.report) as report,
    ):
        progress = train(
            path,
            config,
            extend=extend,
            without_metrics=without_metrics,
            report=report,
            began=began,
        )
    if not is_over(config, progress):
        kept = f"and saved at {progress.env_steps:,} environment steps. Go on"
        if progress.env_steps == 0:
            kept = "before there was anything to save. Begin again"
        go_on = command("race", "resume", path)
        console.print(f"Interrupted {kept} with: {go_on}", soft_wrap=True)
        _tell_of_silence(console, path)
        sys.exit(130)
    following = [
        command("race", "evaluate", path),
        command("race", "render", path, "--out", "team.mp4"),
        command("race", "plot", path, "--out", "curves.png"),
    ]
    if has_no_picture(config.task):
        del following[1]
    console.print(
        f"Finished after {progress.env_steps:,} environment steps. Next: {', '.join(following)}",
        soft_wrap=True,
    )
    _tell_of_silence(console, path)


def _tell_of_silence(console: Console, path: Path) -> None:
    failure = getattr(console.file, "failure", None)
    if failure is not None:
        say(
            f"Standard output could not be written ({failure}); the run went on without. "
            f"All of it is in {path}."
        )
