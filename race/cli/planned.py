"""What several runs would take: processes, memory, time."""

from pathlib import Path
from typing import Any

from race.cli.worker import Watched
from race.config.cohort import CohortConfig


def show_plan(path: Path, runs: dict[str, Any], cohort: CohortConfig) -> None:
    """Lists runs, the process of each, its replay buffer's memory, and the time that is left."""
    from race.cli import streams
    from race.cli.fleet import accelerators, crews
    from race.cli.needs import replay_bytes
    from race.runs import directory as run_directory

    console = streams.console()
    if not runs:  # all of them are known from elsewhere
        console.print("Nothing is left to run.")
        return
    watched = [Watched(path / name, config) for name, config in runs.items()]
    groups = crews(watched, cohort.batching, cohort.width, accelerators())
    longest = max(map(len, runs))
    console.print(f"{'run':<{longest}}  process       steps   replay  state", soft_wrap=True)
    sizes: dict[Any, int] = {}
    for number, group in enumerate(groups, 1):
        for run in group:
            config = run.config
            key = (config.task, config.env, config.env_steps, repr(config.learner), config.facmac)
            if key not in sizes:
                sizes[key] = replay_bytes(config)
            there = run_directory.RunDirectory(run.path).config.exists()
            other = there and run_directory.open_run(run.path) != config
            state = "other settings" if other else run.ended or ("begun" if there else "new")
            steps, size = f"{config.env_steps:,}", f"{sizes[key] / 1e9:.2f} GB"
            line = f"{run.name:<{longest}}  {number:>7}  {steps:>10}  {size:>7}  {state}"
            console.print(line, soft_wrap=True, highlight=False)
    cohorts = f" in {len(groups)} processes" if len(groups) < len(watched) else ""
    console.print(
        f"{len(watched)} runs{cohorts}, {sum(r.config.env_steps for r in watched):,} environment "
        f"steps, in {path}. Nothing was run.",
        soft_wrap=True,
    )
    console.print(_time_left(watched), soft_wrap=True)


def _time_left(runs: list[Watched]) -> str:
    """How long it may take, from runs of the same task and method that have begun here."""
    speeds: dict[tuple[str, str], list[float]] = {}
    left: dict[tuple[str, str], float] = {}
    for run in runs:
        config = run.config
        kind = config.task, config.method
        run.look()
        steps, seconds = run.row.get("env_steps", 0), run.row.get("wall_seconds", 0.0)
        if steps and seconds:
            speeds.setdefault(kind, []).append(steps / seconds)
        short = 0 if run.ended else max(config.env_steps - steps, 0)
        left[kind] = left.get(kind, 0.0) + short
    known = {kind: left[kind] * len(s) / sum(s) for kind, s in speeds.items()}
    unknown = sum(steps for kind, steps in left.items() if kind not in known)
    said = []
    if known:
        hours = sum(known.values()) / 3600
        said.append(f"{hours:,.1f} hours of one process, by the speed of runs that have begun")
    if unknown:
        said.append(f"{unknown:,.0f} steps of tasks and methods of which no run has begun yet")
    return f"Time left: {'; '.join(said) or 'none'}."
