"""What a person sees of a training run: a progress bar, or lines where there is no terminal."""

import time
from types import TracebackType
from typing import Any, final

from rich.console import Console
from rich.progress import BarColumn, SpinnerColumn, TaskID, TextColumn
from rich.progress import Progress as Bar

from race.config.settings import Config
from race.training.run_state import Progress


@final
class TrainingDisplay:
    """Shows the progress of one run; pass `report` to `race.training.trainer.train`."""

    def __init__(self, config: Config, console: Console) -> None:
        self._config = config
        self._console = console
        self._bar = Bar(
            SpinnerColumn(),
            TextColumn("{task.fields[stage]:<14}"),
            BarColumn(bar_width=24),
            TextColumn("{task.percentage:>3.0f}%"),
            TextColumn("{task.fields[details]}"),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task: TaskID = self._bar.add_task(
            "", total=config.env_steps, stage="starting", details=""
        )
        self._origin: tuple[float, float] | None = None
        self._test = ""
        self._rate = 0.0

    def __enter__(self) -> "TrainingDisplay":
        self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._bar.stop()

    def report(self, stage: str, progress: Progress, row: dict[str, Any]) -> None:
        """A `race.training.run.Report`."""
        if progress.gradient_steps == 0 and stage == "learning" and not row:
            stage = "compiling"
        covered = _covered(progress, self._config)
        self._bar.update(
            self._task, completed=covered, stage=stage, details=self._details(progress, covered)
        )
        if "eval/selected/return_mean" in row:
            self._test = test_summary(row)
            self._console.print(self._line(row), soft_wrap=True)

    def _details(self, progress: Progress, covered: float) -> str:
        now = time.monotonic()
        if progress.learning and self._origin is None:
            self._origin = (now, covered)
        parts = [f"generation {progress.generation}"]
        if self._origin is not None and now - self._origin[0] > 1:
            self._rate = (covered - self._origin[1]) / (now - self._origin[0])
        if self._rate > 0:
            left = max(self._config.env_steps - covered, 0) / self._rate
            parts += [f"{self._rate:.0f} steps/s", f"{duration(left)} left"]
        if progress.fitness:
            parts.append(f"population best {rounded(max(progress.fitness))}")
        if progress.generation and progress.marl_return is not None:
            parts.append(f"MARL team {rounded(progress.marl_return)}")
        return " · ".join(parts)

    def _line(self, row: dict[str, Any]) -> str:
        return (
            f"{row['env_steps']:>9,} steps, generation {row['generation']:>4}, "
            f"{duration(row['wall_seconds']):>7}: test return {test_summary(row)}"
        )


def _covered(progress: Progress, config: Config) -> float:
    """Environment steps, those of the current generation counted as its gradient steps go."""
    made = progress.env_steps - progress.env_steps_before
    if not progress.learning or not config.has_marl:
        return float(progress.env_steps)
    learned = progress.gradient_steps - progress.gradient_steps_before
    if config.discrete:
        population = config.n_population_teams if progress.fitness else 0
        episodes = population + config.n_marl_teams
        due = episodes * config.facmac.gradient_steps_per_episode
    else:
        due = made * config.learner.gradient_steps_per_env_step
    return progress.env_steps_before + made * min(learned / max(due, 1.0), 1.0)


def test_summary(row: dict[str, Any]) -> str:
    """The test results in a row of metrics."""
    names = [name for name in ("marl", "champion") if f"eval/{name}/return_mean" in row]
    labels = {"marl": "MARL team", "champion": "champion"}
    return ", ".join(
        f"{labels[name]} {rounded(row[f'eval/{name}/return_mean'])} "
        f"± {rounded(row[f'eval/{name}/return_std'])}"
        + (f" ({row[key]:.0%} won)" if (key := f"eval/{name}/win_rate") in row else "")
        for name in names
    )


def duration(seconds: float) -> str:
    """A time for people to read."""
    minutes, s = divmod(round(seconds), 60)
    hours, m = divmod(minutes, 60)
    return f"{hours}h{m:02}m" if hours else f"{m}m{s:02}s"


def rounded(value: float) -> str:
    """A return for people to read: one decimal, more where it is small."""
    return f"{value:,.1f}" if abs(value) >= 100 else f"{value:.3g}"
