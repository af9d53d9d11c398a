"""The program that compares the package with literal cases of SMAC."""

import copy
import functools
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from race.envs.micro.cases import main

CASES = sorted((Path(__file__).parent / "smac_cases").glob("*.json"))


def test_every_case_of_smac_agrees(capsys: pytest.CaptureFixture[str]) -> None:
    assert len(CASES) == 23
    assert main([str(path) for path in CASES]) == 0
    output = capsys.readouterr().out
    assert all(str(path) in output for path in CASES)
    assert "differs" not in output


@functools.cache
def case_text(name: str) -> str:
    return (CASES[0].parent / f"{name}.json").read_text()


def changed(tmp_path: Path, change: Callable[[dict[str, Any]], object], name: str = "MMM") -> str:
    table = json.loads(case_text(name))
    change(table)
    path = tmp_path / "changed.json"
    path.write_text(json.dumps(table))
    return str(path)


def frame(table: dict[str, Any]) -> dict[str, Any]:
    chosen: dict[str, Any] = table["cases"][1]["frames"][-1]
    return chosen


def add(row: list[Any], k: int, value: float) -> None:
    row[k] += value


@pytest.mark.parametrize(
    ("quantity", "change"),
    [
        ("obs", lambda t: add(frame(t)["obs"][0], -1, 2e-5)),
        ("obs", lambda t: frame(t)["obs"].pop()),
        ("state", lambda t: add(frame(t)["state"], 1, -2e-5)),
        ("state", lambda t: add(frame(t)["state"], 1, math.nan)),
        ("avail_actions", lambda t: add(frame(t)["avail"][3], 0, -1)),
        ("reward", lambda t: t["cases"][0]["frames"][-1].update(reward=3.0)),
        ("terminated", lambda t: frame(t).update(terminated=False)),
        ("info.battle_won", lambda t: frame(t)["info"].update(battle_won=False)),
        ("info.dead_allies", lambda t: frame(t)["info"].update(dead_allies=5)),
        ("info.episode_limit", lambda t: frame(t)["info"].update(episode_limit=True)),
        ("stats.battles_draw", lambda t: t["cases"][1]["stats_after"].update(battles_draw=1)),
        ("obs_size", lambda t: t.update(obs_size=161)),
        ("episode_limit", lambda t: t.update(episode_limit=149)),
    ],
)
def test_a_wrong_value_is_named(
    quantity: str, change: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([changed(tmp_path, change)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines if "differs" in line] == [quantity]
    assert lines[-1] == "not all within 1e-5"


def test_one_wrong_file_among_good_ones(tmp_path: Path) -> None:
    wrong = changed(tmp_path, lambda t: t.update(n_actions=17))
    good = str(CASES[-1])
    assert main([good, wrong, good]) == 1
    assert main([good, good]) == 0


@pytest.mark.parametrize(
    "change",
    [
        lambda t: t.update(map="3s4z"),
        lambda t: t.pop("map"),
        lambda t: t.pop("cases"),
        lambda t: t.pop("obs_size"),
        lambda t: frame(t).pop("obs"),
        lambda t: frame(t).pop("units"),
        lambda t: frame(t)["units"][0].pop("x"),
        lambda t: frame(t).update(units=3),
        lambda t: frame(t).update(actions="north"),
        lambda t: t["cases"][0].update(agent_tags=[1, 2]),
        lambda t: t["cases"][0].update(enemy_tags=None),
        lambda t: t["cases"][0].update(episode_steps_before_first_step="many"),
        lambda t: frame(t).update(obs="nothing"),
        lambda t: frame(t)["obs"][0].pop(),
        lambda t: frame(t).update(info=None),
        lambda t: t.update(map=3),
        lambda t: t.update(cases=3),
    ],
)
def test_unusable_cases(change: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = changed(tmp_path, change)
    assert main([path]) == 2
    assert f"{path}: no usable cases" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["", "{", "[]", "3", "null", '"MMM"', "{}", "\x00"])
def test_files_without_cases(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "broken.json"
    path.write_text(text)
    assert main([str(path)]) == 2
    assert main([str(tmp_path)]) == 2
    assert main([str(tmp_path / "missing.json")]) == 2
    assert capsys.readouterr().err.count("no usable cases: ") == 3


def test_units_of_the_next_battle_are_ignored(tmp_path: Path) -> None:
    """When all are dead the map creates new units, with tags that SMAC does not know."""

    def respawn(table: dict[str, Any]) -> None:
        for case in table["cases"]:
            born = copy.deepcopy(case["frames"][0]["units"])
            for unit in born:
                unit["tag"] += 10_000
            case["frames"][-1]["units"] += born

    assert main([changed(tmp_path, respawn, "so_many_baneling")]) == 0
    assert main([changed(tmp_path, respawn, "MMM")]) == 0
