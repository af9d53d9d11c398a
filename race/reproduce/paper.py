"""The paper's own numbers, read off its figures by eye: within about 3% of the axis."""

import importlib.resources
import json
from functools import cache
from typing import Any


@cache
def _numbers() -> dict[str, Any]:
    text = (importlib.resources.files("race.reproduce") / "paper.json").read_text()
    return dict(json.loads(text))


def points(figure: str, task: str, label: str) -> list[tuple[float, float]]:
    """(environment steps, score) of a curve; empty where it is hidden or not in the paper.

    Versions of environments differ from the paper's: order and gains compare, returns do not.
    """
    found = _numbers().get(figure, {}).get(task, {}).get(label, [])
    return [(float(steps), float(score)) for steps, score in found]
