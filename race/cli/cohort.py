"""The process of a cohort: ``python -m race.cli.cohort BATCHING DIR...``, run by `race.cli.fleet`.

Each run is a directory made before. Exits with 0 if all are finished, 130 if they were interrupted,
1 if one failed, and says of each how it ended.
"""

import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any, cast, get_args

from race.cli.worker import INTERRUPTED
from race.compilation import use_cache
from race.config.cohort import Batching
from race.errors import RaceError, say
from race.runs import directory as run_directory
from race.training.run import Report
from race.training.run_state import Progress
from race.training.trainer import Order, is_over, train_cohort
from race.viewing.logged import logged
from race.viewing.progress import test_summary


def main(arguments: list[str]) -> int:
    """Trains the runs of some directories in lockstep; returns the exit status."""
    batching, *places = arguments
    assert batching in get_args(Batching), batching
    paths = [Path(place) for place in places]
    try:
        with ExitStack() as loggers:
            orders = []
            for path in paths:
                config = run_directory.open_run(path)
                report = loggers.enter_context(logged(path, config, _report(path)))
                orders.append(Order(path, config, report=report))
            use_cache(orders[0].config.compute)  # runs of a cohort are alike
            results = train_cohort(orders, batching=cast(Batching, batching))
    except RaceError as error:
        say(f"race: {error}")
        return 1
    code = 0
    for order, result in zip(orders, results, strict=True):
        if isinstance(result, RaceError):
            say(f"{order.path}: {result}")
            code = 1
        elif not is_over(order.config, result):
            print(f"{order.path}: interrupted at {result.env_steps:,} environment steps")
            code = code or INTERRUPTED
        else:
            print(f"{order.path}: finished")
    return code


def _report(path: Path) -> Report:
    def report(stage: str, progress: Progress, row: dict[str, Any]) -> None:
        if row.get("kind") == "evaluation":
            print(f"{path}: {row['env_steps']:,} steps: {test_summary(row)}", flush=True)

    return report


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
