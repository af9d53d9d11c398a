"""Run directories written by hand, for readers of results."""

import json
from pathlib import Path
from typing import Any

from race.config import saved as configs
from race.config.presets import resolve
from race.config.settings import Config


def written_run(
    path: Path,
    points: list[tuple[int, float]],
    metadata: dict[str, Any] | None = None,
    quantity: str = "return_mean",
    generations: list[dict[str, Any]] | None = None,
    **settings: Any,
) -> Path:
    """A run with tests at some steps, each step a tenth of a second of wall time."""
    config = resolve(Config(settings.pop("task", "mamujoco/Hopper-3x1"), **settings))
    path.mkdir(parents=True)
    (path / "config.json").write_text(json.dumps(configs.to_json(config)))
    rows: list[dict[str, Any]] = list(generations or [])
    for steps, value in points:
        row: dict[str, Any] = {"kind": "evaluation", "env_steps": steps, "wall_seconds": steps / 10}
        for team in ("marl", "champion", "selected", "best"):
            row[f"eval/{team}/{quantity}"] = value
            row[f"eval/{team}/return_mean"] = value
        rows.append(row)
    (path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (path / "metadata.json").write_text(json.dumps(metadata or {"algorithm_version": 2}))
    return path


def experiment(folder: Path, shift: float = 500.0) -> Path:
    """RACE and MATD3, two tasks, five seeds; RACE is better by the shift and by noise."""
    for task, level in (("Hopper-3x1", 1000.0), ("Ant-2x4", 2000.0)):
        for algo, more in (("race", shift), ("matd3", 0.0)):
            for seed in range(1, 6):
                final = level + more + 40.0 * ((seed * (3 if algo == "race" else 2)) % 5)
                written_run(
                    folder / task / algo / f"seed{seed}",
                    [(100, 0.0), (200, final / 2), (300, final)],
                    task=f"mamujoco/{task}",
                    algo=algo,
                    seed=seed,
                )
    return folder
