"""Settings of a run from files."""

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import pytest

from race.cli.train import Train, _parse
from race.config.ablations import ablated
from race.config.files import Wanted, of_mapping, of_record, read_wanted
from race.config.presets import PRESETS, filled
from race.config.saved import to_json
from race.config.settings import Config, LearnerConfig, RaceConfig
from race.envs import make_task
from race.errors import ConfigError
from race.training.asking import settled_with_file

HALF = "mamujoco/HalfCheetah-2x3"
ASKED: list[tuple[dict[str, Any], bool]] = [
    ({"task": HALF}, False),
    ({"task": HALF, "seed": 4, "env_steps": 70_000, "preset": "demo"}, False),
    ({"task": HALF, "algo": "maddpg", "preset": "td3"}, False),
    ({"task": HALF, "base": "facmac", "facmac": {"mixer_size": 8}}, False),
    ({"task": HALF, "algo": "ea", "learner": {"hidden_sizes": [9, 8]}}, False),
    ({"task": HALF, "algo": "merl", "race": {"mutation_fraction": 0.3}}, False),
    ({"task": HALF, "ablation": ["vfm-only", "no-injection"]}, False),
    ({"task": HALF, "ablation": "shared-agents", "race": {"population_size": 7}}, False),
    ({"task": "micro/2s3z", "facmac": {"batch_size": 8}, "checkpoint": {"keep": 3}}, True),
    ({"task": "micro/2s3z", "algo": "facmac", "evaluation": {"every": 20_000}}, True),
]


def resolved(wanted: Wanted, discrete: bool) -> Config:
    return filled(ablated(wanted.config, wanted.ablation, discrete), discrete)


@pytest.mark.parametrize(("asked", "discrete"), ASKED)
def test_a_record_asks_for_the_run_that_it_is_of(asked: dict[str, Any], discrete: bool) -> None:
    config = resolved(of_mapping(asked), discrete)
    again = of_record(config)
    assert resolved(again, discrete) == config
    # What presets would fill in is not asked for.
    assert "race.vmm_weight" not in again.settings
    assert "evaluation.episodes" not in again.settings
    assert again.preset == asked.get("preset", "paper")


def test_a_file_of_a_run_is_read(tmp_path: Path) -> None:
    config = resolved(of_mapping(ASKED[1][0]), False)
    file = tmp_path / "config.json"
    file.write_text(json.dumps(to_json(config) | {"run": "abc", "digest": "def"}))
    assert read_wanted(file) == of_record(config)


def test_groups_may_be_dataclasses() -> None:
    wanted = of_mapping({"learner": LearnerConfig(batch_size=9), "race": {}, "seed": 3})
    assert wanted.settings == {"learner.batch_size": 9, "seed": 3}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("task = ", "is no TOML"),
        ("tsk = 1", "Did you mean task"),
        ("[lerner]\nx = 1", "Did you mean learner"),
        ("[learner]\nhiden_sizes = [1, 2]", "Did you mean hidden_sizes"),
        ("[learner]\nbatch_size = 2.5", "but must be a whole number"),
        ('algo = "rase"', "must be one of 'race', 'merl'"),
        ('preset = "x"', "There is no preset"),
        ('ablation = "x"', "There is no ablation"),
        ("ablation = 3", "must be a name"),
        ("ablation = [[]]", "There is no ablation"),
        ("seeds = [1, 2]", "race sweep"),
        ("learner = 3", "must be a table"),
    ],
)
def test_mistakes_in_a_file_are_named(text: str, words: str, tmp_path: Path) -> None:
    file = tmp_path / "a.toml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=words) as told:
        read_wanted(file)
    assert "a.toml" in str(told.value)


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"task": 3}'])
def test_what_is_no_record_is_refused(text: str, tmp_path: Path) -> None:
    file = tmp_path / "config.json"
    file.write_text(text)
    with pytest.raises(ConfigError, match=re.escape(str(file))):
        read_wanted(file)
    with pytest.raises(ConfigError, match="cannot be read"):
        read_wanted(tmp_path / "nothing.toml")


FILE = """
task = "probe/target"
seed = 5
preset = "demo"
[learner]
batch_size = 16
[race]
population_size = 6
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "a.toml"
    path.write_text(FILE)
    return path


def test_options_come_on_top_of_a_file(file: Path) -> None:
    chosen = _parse(["--config", str(file), "--learner.batch-size", "8"])
    assert isinstance(chosen, Train)
    assert (chosen.task, chosen.seed, chosen.preset) == ("probe/target", 5, "demo")
    assert chosen.learner == dataclasses.replace(PRESETS["demo"], batch_size=8)
    assert chosen.race == RaceConfig(population_size=6)
    other = _parse(["probe/chain", f"--config={file}", "--preset", "td3", "--seed", "2"])
    assert (other.task, other.seed) == ("probe/chain", 2)
    assert other.learner == dataclasses.replace(PRESETS["td3"], batch_size=16)


def test_a_task_is_needed_where_no_file_names_one(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        _parse([])
    assert "TASK" in capsys.readouterr().err


def test_settings_of_a_file_that_have_no_effect_are_left_out_and_told(
    file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wanted, task = read_wanted(file), make_task("probe/target")
    asked = dataclasses.replace(wanted.config, algo="matd3")
    config = settled_with_file(asked, "demo", (), task, wanted, "a.toml")
    assert config.race.population_size == RaceConfig().population_size
    assert config.learner.batch_size == 16
    assert "a.toml: left out" in capsys.readouterr().err
    said = dataclasses.replace(asked, race=RaceConfig(population_size=9))  # by a person, beside it
    with pytest.raises(ConfigError, match="population-size would have no effect"):
        settled_with_file(said, "demo", (), task, wanted, "a.toml")
