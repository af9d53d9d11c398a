"""``race reproduce``."""

import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from race.config.cohort import CohortConfig
from race.config.compute import ComputeConfig
from race.config.loggers import LoggerName
from race.config.settings import (
    CheckpointConfig,
    Config,
    EvaluationConfig,
    FacmacConfig,
    LearnerConfig,
    Preset,
    RaceConfig,
)
from race.errors import ConfigError, RaceError

Wanted = Literal["fig2", "fig3", "fig4", "fig5", "fig6", "fig7", "fig8", "all"]


@dataclass(frozen=True)
class Reproduce:
    """Make figures of the paper: plan their runs, train what is missing, draw.

    fig2 and fig3: RACE, MERL, the gradient learners and EA on Multi-Agent MuJoCo and StarCraft's
    maps; fig4: what became of injected teams; fig5 to fig8: ablations, alpha, beta, on four tasks
    of our choice, since the paper does not name its own. Given again, the same command goes on with
    what is unfinished, leaves what is done, and draws anew. All of the paper is months of work for
    one machine: look at --dry-run, --tasks and --scale first.
    """

    figures: Annotated[tuple[Wanted, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FIG...")]
    """fig2 ... fig8, or all."""
    seeds: str = "1-5"
    """Seeds of every curve, such as 1-5 or 1,4,7."""
    tasks: tuple[str, ...] = ()
    """These tasks instead of the figure's."""
    env_steps: int | None = None
    """Environment steps of every run. None: the paper's, one million, on three maps two."""
    scale: float = 1.0
    """The same plan on so much of the budget: 0.1 is a tenth."""
    jobs: int | None = None
    """Processes at a time, each kept on one core. None: as many as cores, or as accelerators."""
    on: Annotated[str | None, tyro.conf.arg(metavar="CLUSTER")] = None
    """Run them on a Ray cluster: ray://HOST:PORT, or ray, which starts one of this machine. Runs
    must lie in a folder that all machines share. Needs race-marl[ray]; see docs/cluster.md."""
    dir: Path = Path("runs/reproduce")
    """Where runs and figures are kept."""
    known: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="PATH...")] = ()
    """Run directories, folders of them or archives (`race archive`) in which complete runs of the
    figures may be: they are drawn, and not trained again."""
    dry_run: bool = False
    """Say what would be run, with memory and, where runs of the kind have begun, time."""
    draw_only: bool = False
    """Draw what there is and run nothing."""
    team: Literal["selected", "marl", "champion", "best"] = "selected"
    """Whose tests are drawn. best, the larger of two tests, is what the paper shows: biased."""
    preset: Preset = "paper"
    """Learner settings to start from, on tasks with continuous actions."""
    log: tuple[LoggerName, ...] = ()
    """Programs that new runs tell every row besides (`race train --help`)."""
    learner: LearnerConfig = field(default_factory=LearnerConfig)
    facmac: FacmacConfig = field(default_factory=FacmacConfig)
    race: RaceConfig = field(default_factory=RaceConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    checkpoint: CheckpointConfig = field(default_factory=CheckpointConfig)
    compute: ComputeConfig = field(default_factory=ComputeConfig)
    cohort: CohortConfig = field(default_factory=CohortConfig)


def main(arguments: list[str]) -> None:
    """Parses the arguments, plans, trains, draws."""
    chosen = tyro.cli(Reproduce, args=arguments, prog="race reproduce")
    from race.cli.fleet import check_jobs, run_all
    from race.cli.planned import show_plan
    from race.cli.sweep import create_runs
    from race.cli.worker import SHARED_ACCELERATOR
    from race.compilation import use_cache
    from race.config.seeds import parse_seeds
    from race.reproduce.figures import FIGURES
    from race.reproduce.known import known_of
    from race.reproduce.planning import plan
    from race.runs import results

    if not chosen.figures:
        raise ConfigError("Say which figure: race reproduce {fig2,...,fig8,all}")
    check_jobs(chosen.jobs, chosen.on)
    figures = tuple(FIGURES) if "all" in chosen.figures else tuple(dict.fromkeys(chosen.figures))
    groups = ("learner", "facmac", "race", "evaluation", "checkpoint", "compute")
    made = plan(
        figures,
        parse_seeds(chosen.seeds),
        Config("", **{name: getattr(chosen, name) for name in groups}),
        tasks=chosen.tasks,
        env_steps=chosen.env_steps,
        scale=chosen.scale,
        preset=chosen.preset,
    )
    os.environ.update(SHARED_ACCELERATOR)  # this process only watches
    use_cache()
    known = known_of(made.runs, results.load(chosen.known))
    missing = {name: config for name, config in made.runs.items() if name not in known}
    if known or chosen.known:
        print(f"{len(known)} of {len(made.runs)} runs are known.", file=sys.stderr)
    if chosen.dry_run:
        show_plan(chosen.dir, missing, chosen.cohort)
        return
    failure = None
    if missing and not chosen.draw_only:
        create_runs(chosen.dir, missing, chosen.log, "--dir")
        places = [chosen.dir / name for name in missing]
        try:
            run_all(chosen.dir, places, jobs=chosen.jobs, cohort=chosen.cohort, on=chosen.on)
        except RaceError as error:  # what the others did is drawn all the same
            failure = error
        except SystemExit:
            print("The same command goes on too, and draws the figures.")
            raise
    _draw(chosen, figures, made, known)
    if failure is not None:
        raise failure


def _draw(chosen: Reproduce, figures: tuple[str, ...], made: Any, known: dict[str, Any]) -> None:
    from race.reproduce.drawing import draw_figure
    from race.reproduce.figures import FIGURES
    from race.runs import results
    from race.runs.directory import RunDirectory

    there = [n for n in made.runs if n in known or RunDirectory(chosen.dir / n).config.exists()]
    if not there:
        raise RaceError(
            f"There is no run of these figures in {chosen.dir}. Leave --draw-only away to train "
            "them, or name the folder with --dir, or others that hold them with --known."
        )
    recorded = {n: known.get(n) or results.of_directory(chosen.dir / n) for n in there}
    for figure in figures:
        runs = [(recorded[n], p) for n in there for p in made.seen[n] if p.figure == figure]
        tasks, out = chosen.tasks or FIGURES[figure].tasks, chosen.dir / f"{figure}.png"
        drawn = draw_figure(figure, runs, tasks, chosen.team, out)
        if drawn is None:
            print(f"{figure}: nothing to draw yet.", file=sys.stderr)
            continue
        print(f"Figure: {drawn.file}")
        print(*(f"Missing: {gap}." for gap in drawn.gaps), sep="\n", end="", file=sys.stderr)
        absent = sum(any(p.figure == figure for p in made.seen[n]) for n in made.runs) - len(runs)
        if absent > 0:
            print(f"Missing: {figure}: {absent} runs are not begun.", file=sys.stderr)
