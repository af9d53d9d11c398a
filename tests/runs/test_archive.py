"""Archives: what they keep, how small they are, and that readers take them like directories."""

import dataclasses
import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from race import ALGORITHM_VERSION
from race.config import settings as configs
from race.config.presets import resolve
from race.config.settings import Config, FacmacConfig, LearnerConfig, RaceConfig
from race.errors import RaceError, RunDirectoryError
from race.runs import archive
from race.runs import directory as run_directory
from race.runs.recorded import Recorded, experiment_key
from race.runs.results import load
from race.viewing.plotting import plot

TASK = "mamujoco/Hopper-3x1"


def rows_of(evaluations: int, seed: int = 0) -> list[dict[str, Any]]:
    """What a run writes: two generations, then an evaluation, and so on; one more generation."""
    rng = np.random.default_rng(seed)
    found: list[dict[str, Any]] = []
    for i in range(2 * evaluations + 1):
        counted = {"generation": i + 1, "env_steps": 6000 * (i + 1), "wall_seconds": 60.5 * (i + 1)}
        row = {"kind": "generation", **counted, "gradient_steps": 6000 * i}
        row |= {f"loss/{name}": float(rng.normal()) for name in ("critic", "policy", "value")}
        row |= {"marl/return": float(rng.normal()), "injection/elite_rate": i / (i + 1)}
        found.append(row)
        if i % 2:
            scores = {
                f"eval/{team}/{what}": float(rng.normal(1000, 100))
                for team in ("marl", "champion", "selected", "best")
                for what in ("return_mean", "return_std", "length_mean")
            }
            found.append({"kind": "evaluation", **counted, "gradient_steps": 6000 * i, **scores})
    return found


def make_run(path: Path, evaluations: int = 3, **changes: Any) -> Path:
    config = resolve(Config(TASK, **changes))
    run_directory.create(path, config)
    text = "".join(json.dumps(row) + "\n" for row in rows_of(evaluations, config.seed))
    (path / "metrics.jsonl").write_text(text)
    return path


def archived(out: Path, *paths: Path) -> list[Recorded]:
    archive.write(out, load(paths))
    return load([out])


def test_evaluations_are_kept_whole_and_generations_thinned(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", seed=3)
    (found,) = archived(tmp_path / "all.jsonl.gz", run)
    (whole,) = load([run])
    assert found.config == whole.config
    assert found.experiment == whole.experiment
    assert found.algorithm_version == ALGORITHM_VERSION
    kinds = [row["kind"] for row in found.rows]
    assert kinds == ["generation", "evaluation"] * 3 + ["generation"]
    before = [row for row in whole.rows if row["kind"] == "evaluation"]
    after = [row for row in found.rows if row["kind"] == "evaluation"]
    for old, new in zip(before, after, strict=True):
        assert set(old) == set(new)
        for key, value in old.items():
            assert new[key] == (value if isinstance(value, str) else pytest.approx(value, rel=1e-5))
    generations = [row for row in whole.rows if row["kind"] == "generation"]
    one = found.rows[2]  # of generations 3 and 4
    pair = generations[2:4]
    assert (one["generation"], one["env_steps"], one["gradient_steps"]) == (4, 24_000, 18_000)
    assert one["injection/elite_rate"] == 0.75
    for key in ("loss/critic", "marl/return"):
        assert one[key] == pytest.approx((pair[0][key] + pair[1][key]) / 2, rel=1e-5)
    assert found.rows[-1]["generation"] == 7  # what came after the last evaluation


def test_five_hundred_runs_take_less_than_ten_megabytes(tmp_path: Path) -> None:
    paths = [make_run(tmp_path / f"s{seed}", 40, seed=seed) for seed in range(1, 26)]
    archived(tmp_path / "all.jsonl.gz", *paths)
    assert 20 * (tmp_path / "all.jsonl.gz").stat().st_size < 10e6


def test_equal_runs_give_equal_bytes(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    for name in ("a", "b"):
        archived(tmp_path / f"{name}.jsonl.gz", run)
    one, two = ((tmp_path / f"{name}.jsonl.gz").read_bytes() for name in ("a", "b"))
    assert one == two


def test_archives_are_read_like_directories_and_can_be_joined(tmp_path: Path) -> None:
    paths = [make_run(tmp_path / f"s{seed}", seed=seed) for seed in (1, 2)]
    archived(tmp_path / "one.jsonl.gz", paths[0])
    both = archived(tmp_path / "both.jsonl.gz", tmp_path / "one.jsonl.gz", paths[1])
    assert [run.config.seed for run in both] == [1, 2]
    direct = plot(paths, tmp_path / "a.png").summaries
    kept = plot([tmp_path / "both.jsonl.gz"], tmp_path / "b.png").summaries
    for one, two in zip(direct, kept, strict=True):
        assert (one.task, one.curve, one.seeds) == (two.task, two.curve, two.seeds)
        assert two.mean == pytest.approx(one.mean, rel=1e-5)


def test_runs_of_equal_names_are_all_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for seed in (1, 2):
        folder = tmp_path / f"machine{seed}"
        make_run(folder / "run", seed=seed)
        monkeypatch.chdir(folder)
        archived(tmp_path / f"{seed}.jsonl.gz", Path("run"))
    both = archived(tmp_path / "both.jsonl.gz", *tmp_path.glob("?.jsonl.gz"))
    assert sorted(run.config.seed for run in both) == [1, 2]


def test_folders_of_archives_are_found_and_nothing_counts_twice(tmp_path: Path) -> None:
    run = make_run(tmp_path / "runs" / "run")
    kept = tmp_path / "kept" / "deep" / "all.jsonl.gz"
    archived(kept, run)
    assert [run.config.seed for run in load([tmp_path / "kept", kept])] == [1]
    with pytest.raises(RaceError, match="same experiment with the same seed"):
        plot([tmp_path / "runs", tmp_path / "kept"], tmp_path / "a.png")


def test_settings_that_a_method_has_no_use_for_do_not_part_experiments() -> None:
    def key(**changes: Any) -> str:
        return experiment_key(resolve(Config(TASK, **changes)), ALGORITHM_VERSION)

    alone = key(algo="matd3")
    assert key(algo="matd3", race=RaceConfig(population_size=7)) == alone
    assert key(algo="matd3", facmac=FacmacConfig(mixer_size=7)) == alone
    assert key(algo="facmac", facmac=FacmacConfig(mixer_size=7)) != key(algo="facmac")
    assert key(race=RaceConfig(population_size=7)) != key()


def test_the_key_tells_experiments_apart() -> None:
    base = resolve(Config(TASK))

    def key(version: int = ALGORITHM_VERSION, **changes: Any) -> str:
        return experiment_key(dataclasses.replace(base, **changes), version)

    same = [
        key(),
        key(seed=4),
        key(env_steps=50_000),
        key(checkpoint=configs.CheckpointConfig(1.0)),
    ]
    assert len(set(same)) == 1
    other = [
        key(version=1),
        key(task="mamujoco/Ant-2x4"),
        key(algo="matd3"),
        key(learner=LearnerConfig(discount=0.9)),
        key(race=RaceConfig(mutation_draw="weight")),
    ]
    assert len({*same, *other}) == 6


def test_what_is_no_archive_says_so(tmp_path: Path) -> None:
    bad = tmp_path / "bad.jsonl.gz"
    bad.write_bytes(b"not gzip")
    with pytest.raises(RunDirectoryError, match="cannot be read"):
        load([bad])
    whole = tmp_path / "whole.jsonl.gz"
    archived(whole, make_run(tmp_path / "run"))
    bad.write_bytes(whole.read_bytes()[:-40])
    with pytest.raises(RunDirectoryError, match="no archive that this version"):
        load([bad])
    flipped = bytearray(whole.read_bytes())
    for place in range(12, len(flipped), len(flipped) // 60):
        bad.write_bytes(bytes([*flipped[:place], flipped[place] ^ 64, *flipped[place + 1 :]]))
        with pytest.raises(RunDirectoryError):
            load([bad])
    for text in ("", "[]\n", json.dumps(archive.FORMAT) + "\n{}\n", '{"version": 9}\n'):
        bad.write_bytes(gzip.compress(text.encode()))
        with pytest.raises(RunDirectoryError, match="no archive that this version"):
            load([bad])
    with pytest.raises(RunDirectoryError, match="must end with"):
        archive.write(tmp_path / "a.json", [])
    with pytest.raises(RunDirectoryError, match="cannot be read"):
        load([tmp_path / "missing.jsonl.gz"])


def test_settings_of_an_older_version_are_what_it_did(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    data = json.loads((run / "config.json").read_text())
    del data["run"], data["digest"]
    for group, name in (("learner", "layer_norm"), ("facmac", "layer_norm")):
        del data[group][name]
    for name in ("mutation_draw", "elite_copy"):
        del data["race"][name]
    (run / "config.json").write_text(json.dumps(data))
    (run / "metadata.json").unlink()
    (found,) = load([run])
    assert found.algorithm_version == 1
    assert (found.config.learner.layer_norm, found.config.facmac.layer_norm) == (False, False)
    assert (found.config.race.mutation_draw, found.config.race.elite_copy) == ("weight", False)
