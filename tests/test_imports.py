"""Imports go one way, so that each part can be understood without those above it."""

import ast
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "race"

# From the ground up. A part may import what lies on the floors below its own and, within itself,
# whatever goes round in no circle; it may not import its neighbours.
FLOORS: tuple[frozenset[str], ...] = tuple(
    map(
        frozenset,
        (
            {"", "closing", "errors"},
            {"loading"},
            {"config", "types"},
            {"compilation", "method", "randomness"},
            {"networks", "replay", "runs", "envs", "statistics"},
            {"learners"},
            {"algorithms"},
            {"programs"},
            {"rollouts"},
            {"training"},
            {"teams"},
            {"viewing"},
            {"reproduce"},
            {"doctor"},
            {"bench"},
            {"api"},
            {"cli"},
            {"__main__"},
        ),
    )
)
FLOOR = {part: number for number, floor in enumerate(FLOORS) for part in floor}

Graph = dict[str, set[str]]


def part_of(module: str) -> str:
    """The name under `race` that a module belongs to; "" is `race` itself."""
    return [*module.split("."), ""][1]


def modules_of(package: Path) -> dict[str, str]:
    """The source of every module below ``package``, by its dotted name."""
    found = {}
    for path in sorted(package.rglob("*.py")):
        parts = path.relative_to(package.parent).with_suffix("").parts
        found[".".join(parts).removesuffix(".__init__")] = path.read_text()
    return found


def imports_of(module: str, source: str, modules: set[str]) -> Iterator[str]:
    """The modules of the project that one imports, wherever in it, functions included."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in modules)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: imports are absolute"
            for alias in node.names:
                # `from race.networks import critics` names a module as `import` does.
                named = f"{node.module}.{alias.name}"
                if named in modules or node.module in modules:
                    yield named if named in modules else str(node.module)


def graph_of(sources: dict[str, str]) -> Graph:
    names = set(sources)
    return {m: set(imports_of(m, source, names)) - {m} for m, source in sources.items()}


def arrows_upwards(graph: Graph) -> list[str]:
    return [
        f"{module} imports {other}"
        for module, others in sorted(graph.items())
        for other in sorted(others)
        if part_of(other) != part_of(module) and FLOOR[part_of(other)] >= FLOOR[part_of(module)]
    ]


def circle(graph: Graph) -> list[str]:
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


GRAPH = graph_of(modules_of(PACKAGE))


def test_every_part_has_a_floor() -> None:
    assert {part_of(module) for module in GRAPH} == set(FLOOR)


def test_no_arrow_runs_back_up() -> None:
    assert not arrows_upwards(GRAPH)


def test_no_files_import_each_other_in_a_circle() -> None:
    assert not circle(GRAPH)


def test_algorithms_and_learners_know_no_environment() -> None:
    for module, others in GRAPH.items():
        if part_of(module) in {"learners", "algorithms", "method", "networks"}:
            assert "envs" not in {part_of(other) for other in others}


@pytest.mark.parametrize(
    ("source", "names"),
    [
        ("import race.envs.mamujoco as m", {"race.envs.mamujoco"}),
        ("from race.rollouts.host import Pool", {"race.rollouts.host"}),
        ("from race.runs import metrics, trees", {"race.runs.metrics", "race.runs.trees"}),
        ("def f():\n    from race.envs import make_task", {"race.envs"}),
        ("import race", {"race"}),
        ("import racer, jax\nfrom jax import race", set()),
    ],
)
def test_the_reader_of_imports(source: str, names: set[str]) -> None:
    assert set(imports_of("m", source, set(GRAPH))) == names


def test_arrows_upwards_and_circles_would_be_found() -> None:
    upwards = {"race.learners.new": "from race.rollouts.host import Pool"}
    assert arrows_upwards(graph_of({**modules_of(PACKAGE), **upwards})) == [
        "race.learners.new imports race.rollouts.host"
    ]
    sideways = {"race.replay.new": "def f():\n    from race.runs import directory"}
    assert arrows_upwards(graph_of({**modules_of(PACKAGE), **sideways}))
    inside = {"race.a.b": "from race.a import c", "race.a.c": "def f():\n    import race.a.b"}
    assert set(circle(graph_of(inside))) == {"race.a.b", "race.a.c"}


PACKAGES = sorted(str(p.parent.relative_to(PACKAGE)) for p in PACKAGE.rglob("*/__init__.py"))


@pytest.mark.parametrize("package", PACKAGES)
def test_every_package_says_what_lives_there(package: str) -> None:
    source = (PACKAGE / package / "__init__.py").read_text()
    said = ast.get_docstring(ast.parse(source)) or ""
    assert len([line for line in said.splitlines() if line]) >= 2, f"race/{package}: {said!r}"
