"""Imports go one way, so that each part can be understood without those above it."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "race"
GROUND = {"types", "config", "errors", "checks", "presets"}
MATHEMATICS = {
    "equations",
    "genetics",
    "networks",
    "critics",
    "optimization",
    "packing",
    "replay",
    "returns",
    "exploration",
    "gru",
    "recurrent",
    "factored",
}
# Top-level name under `race` -> the names it may import from `race`, besides its own.
ALLOWED = {
    **dict.fromkeys(GROUND, GROUND),
    **dict.fromkeys(MATHEMATICS, GROUND | MATHEMATICS),
    "learners": GROUND | MATHEMATICS,
    "algorithms": GROUND | MATHEMATICS | {"learners"},
    "envs": GROUND,
}


def imported(source: str) -> set[str]:
    """Top-level names under `race` that a module imports, wherever in it; "" is `race` itself."""
    modules: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            # `from race import critics` names a module just as `import race.critics` does.
            inner = [f"race.{alias.name}" for alias in node.names]
            modules |= set(inner) if node.module == "race" else {node.module or ""}
    paths = [module.split(".") for module in modules]
    return {path[1] if len(path) > 1 else "" for path in paths if path[0] == "race"}


def files_of(part: str) -> list[Path]:
    path = PACKAGE / part
    return sorted(path.rglob("*.py")) if path.is_dir() else [path.with_suffix(".py")]


@pytest.mark.parametrize("part", sorted(ALLOWED))
def test_imports_go_one_way(part: str) -> None:
    for path in files_of(part):
        wrong = imported(path.read_text()) - ALLOWED[part] - {part}
        assert not wrong, f"{path.relative_to(PACKAGE)} imports {sorted(wrong)}"


@pytest.mark.parametrize(
    ("source", "names"),
    [
        ("import race.envs.mamujoco as m", {"envs"}),
        ("from race.rollouts.host import Pool", {"rollouts"}),
        ("from race import critics, types", {"critics", "types"}),
        ("def f():\n    from race.envs import make", {"envs"}),
        ("import race", {""}),
        ("import racer, jax\nfrom jax import race", set()),
    ],
)
def test_the_reader_of_imports(source: str, names: set[str]) -> None:
    assert imported(source) == names


def test_every_part_is_there() -> None:
    assert all(path.exists() for part in ALLOWED for path in files_of(part))
    assert all(files_of(part) for part in ALLOWED)
