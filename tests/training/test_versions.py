"""A run of version 0.1.0, kept as it was: it can be looked at, but not gone on with."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from race.errors import CheckpointError, ConfigError, HandedOverError
from race.runs import archive
from race.runs import directory as run_directory
from race.runs.results import load
from race.teams.trained import load_trained
from race.training.trainer import train
from race.viewing.plotting import plot


@pytest.fixture
def old(tmp_path: Path) -> Path:
    return Path(shutil.copytree(Path(__file__).parent / "version1", tmp_path / "old"))


def test_its_settings_say_what_it_did(old: Path) -> None:
    config = run_directory.open_run(old)
    assert (config.learner.layer_norm, config.facmac.layer_norm) == (False, False)
    assert (config.race.mutation_draw, config.race.elite_copy) == ("weight", False)
    (run,) = load([old])
    assert run.algorithm_version == 1


def test_its_team_plays(old: Path) -> None:
    trained = load_trained(old)
    for team in ("marl", "champion", "selected"):
        action = trained.policy(team)(np.zeros(trained.task.spec.state_size, np.float32))
        assert action.shape == (trained.task.spec.joint_action_size,)
        assert np.isfinite(action).all()
        for wrong in (np.zeros(trained.task.spec.state_size + 1), np.full_like(action, np.nan)):
            with pytest.raises(HandedOverError, match="The team was shown what no environment of"):
                trained.policy(team)(wrong)


def test_it_is_drawn_and_archived(old: Path, tmp_path: Path) -> None:
    (summary,) = plot([old], tmp_path / "a.png").summaries
    archive.write(tmp_path / "all.jsonl.gz", load([old]))
    (kept,) = plot([tmp_path / "all.jsonl.gz"], tmp_path / "b.png").summaries
    assert kept.mean == pytest.approx(summary.mean)
    assert load([tmp_path / "all.jsonl.gz"])[0].algorithm_version == 1


def test_it_does_not_go_on(old: Path) -> None:
    config = run_directory.open_run(old)
    with pytest.raises(ConfigError, match="has finished"):
        train(old, config)
    data = json.loads((old / "config.json").read_text())
    (old / "config.json").write_text(json.dumps({**data, "env_steps": 500}))
    (old / "DONE").unlink()
    before = (old / "metrics.jsonl").read_bytes()
    with pytest.raises(CheckpointError, match="another version of race"):
        train(old, run_directory.open_run(old))
    assert (old / "metrics.jsonl").read_bytes() == before
    # Nor does it begin again as if nothing had been, when it had no checkpoint yet.
    shutil.rmtree(old / "checkpoints")
    with pytest.raises(CheckpointError, match="another version of race"):
        train(old, run_directory.open_run(old))
