"""The reader of compiled programs against known products; the suite's choice and its output."""

import json
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from race.bench import evolution, suite
from race.bench.measurement import Measurement, Subject, interleaved_best
from race.bench.products import (
    Product,
    operations,
    products_alone,
    products_in,
    random_operands,
    run_products,
)
from race.cli.bench import main
from race.config.presets import resolve
from race.config.settings import Config, RaceConfig
from race.errors import RaceError

HLO = """\
HloModule jit_f, entry_computation_layout={(f32[4,3]{1,0})->f32[4,5]{1,0}}

%wrapped_dot (param_0.1: f32[2,4,3], param_1.1: f32[2,5,3]) -> f32[2,4,5] {
  %param_0.1 = f32[2,4,3]{2,1,0} parameter(0)
  %param_1.1 = f32[2,5,3]{2,1,0} parameter(1)
  ROOT %dot.1 = f32[2,4,5]{2,1,0} dot(%param_0.1, %param_1.1), lhs_batch_dims={0}, \
lhs_contracting_dims={2}, rhs_batch_dims={0}, rhs_contracting_dims={2}, metadata={op_name=" dot(b)"}
}

ENTRY %main.5 (x.1: f32[4,3], y.1: f32[4,7]) -> f32[3,7] {
  %x.1 = f32[4,3]{1,0} parameter(0)
  %y.1 = f32[4,7]{1,0} parameter(1)
  %param_0.1 = f32[7,1]{1,0} constant({...})
  %called = f32[2,4,5]{2,1,0} fusion(%a, %b), kind=kOutput, calls=%wrapped_dot
  %product = f32[3,7]{1,0} dot(f32[4,3]{1,0} %x.1, f32[4,7]{1,0} %y.1), \
lhs_contracting_dims={0}, rhs_contracting_dims={0}
  ROOT dot.2 = f32[3,1]{1,0} dot(product, param_0.1), lhs_contracting_dims={1}, \
rhs_contracting_dims={0}
}
"""


def test_products_of_a_written_program() -> None:
    none = ((), ())
    assert products_in(HLO) == [
        Product("float32", (2, 4, 3), (2, 5, 3), ((2,), (2,)), ((0,), (0,))),
        Product("float32", (4, 3), (4, 7), ((0,), (0,)), none),
        # A name means what it means in its own computation.
        Product("float32", (3, 7), (7, 1), ((1,), (0,)), none),
    ]
    assert [p.operations for p in products_in(HLO)] == [2 * 2 * 4 * 3 * 5, 2 * 3 * 4 * 7, 2 * 3 * 7]


def test_an_operand_without_a_definition_is_refused() -> None:
    with pytest.raises(ValueError, match="not defined"):
        products_in(HLO.replace("%y.1)", "%z.1)"))


def test_products_of_a_compiled_program() -> None:
    def f(x: Any, w: Any, v: Any) -> Any:
        hidden = jnp.tanh(jnp.einsum("bi,kih->kbh", x, w))
        return jax.lax.cond(x[0, 0] > 0, lambda: hidden @ v, lambda: hidden[:, :, :40])

    shapes = (64, 32), (3, 32, 48), (3, 48, 40)
    text = jax.jit(f).lower(*(jnp.ones(shape) for shape in shapes)).compile().as_text()
    assert text is not None
    assert sorted(p.operations for p in products_in(text)) == [
        2 * 3 * 64 * 32 * 48,
        2 * 3 * 64 * 48 * 40,
    ]


def test_products_in_a_loop_count_as_often_as_it_turns() -> None:
    def f(x: Any, w: Any) -> Any:
        return jax.lax.scan(lambda y, v: (jnp.tanh(y @ v), None), x, w)[0]

    text = jax.jit(f).lower(jnp.ones((8, 16)), jnp.ones((5, 16, 16))).compile().as_text()
    assert text is not None
    assert [p.operations for p in products_in(text)] == 5 * [2 * 8 * 16 * 16]


def test_the_program_of_products_alone_computes_all_of_them() -> None:
    products = products_in(HLO)
    products += 10 * [products[1]]  # enough for a loop
    # Twice the same product: neither may be merged with the other.
    products.append(products[0])
    compiled = run_products.lower(
        random_operands(products), np.int32(2), products=tuple(products)
    ).compile()
    text = compiled.as_text()
    assert text is not None
    assert operations(products_in(text)) == operations(products)
    assert all(np.isfinite(array).all() for array in jax.tree.leaves(products_alone(products)(2)))


def test_each_run_is_timed_in_turn() -> None:
    calls: list[str] = []
    best = interleaved_best([lambda: calls.append("a"), lambda: calls.append("b")], 2)
    assert calls == ["a", "b"] * 3
    assert len(best) == 2


def made_up() -> list[Subject]:
    def fast() -> list[Measurement]:
        return [Measurement("x/ms", 2.0, "ms", 3.0), Measurement("x/ratio", 2.0, "", 1.5)]

    def never() -> list[Measurement]:
        raise AssertionError("was not asked for")

    return [Subject(("x/ms", "x/ratio"), fast), Subject(("y/ms",), never)]


@pytest.mark.parametrize(
    ("pattern", "names"),
    [("x/", ["x/ms", "x/ratio"]), ("x*s", ["x/ms"]), ("*ratio", ["x/ratio"]), ("?/r", [])],
)
def test_only_what_is_asked_for_is_measured(pattern: str, names: list[str]) -> None:
    if not names:
        with pytest.raises(RaceError, match=r"(?s)called '\?/r'.*x/ms.*x/ratio.*y/ms"):
            suite.chosen(made_up(), pattern)
        return
    begun: list[Subject] = []
    results = suite.measure(suite.chosen(made_up(), pattern), pattern, begun.append)
    assert [result.name for result in results] == names
    assert [subject.names[0] for subject in begun] == ["x/ms"]


def test_json_and_table(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(suite, "subjects", made_up)
    main(["--json", "--only", "x"])
    assert json.loads(capsys.readouterr().out) == [
        {"name": "x/ms", "value": 2.0, "unit": "ms", "goal": 3.0, "met": True},
        {"name": "x/ratio", "value": 2.0, "unit": "", "goal": 1.5, "met": False},
    ]
    main(["--only", "x"])
    printed = capsys.readouterr()
    assert "not met" in printed.out
    assert "1/1 x/ms" in printed.err


def test_names_are_distinct_and_measurements_have_no_goal_unless_given() -> None:
    names = [name for subject in suite.subjects() for name in subject.names]
    assert len(set(names)) == len(names)
    assert Measurement("x", 1.0, "s").met is None


def test_evolution_is_measured_as_training_makes_it() -> None:
    config = resolve(Config("probe/target", race=RaceConfig(population_size=8)))
    evolved = evolution.Evolutions(config)
    first, second = evolved(), evolved()
    origins = [[team["origin"] for team in row["teams"]] for row in (first, second)]
    assert origins[0] == ["initial"] * 8
    assert origins[1].count("injected") == origins[1].count("elite") == 1
    assert second["injection/discarded_rate"] is not None
