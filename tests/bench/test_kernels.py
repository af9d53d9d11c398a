"""The count of kernels against a program counted by hand, and against how real ones grow."""

import jax
import jax.numpy as jnp
import pytest

from race.bench import micro, suite
from race.bench.kernels import kernels_in
from race.envs.micro import map_names

HLO = """\
HloModule jit_f, is_scheduled=true, entry_computation_layout={(f32[4]{0})->f32[4]{0}}

%add.1 (a: f32[], b: f32[]) -> f32[] {
  %a = f32[] parameter(0)
  %b = f32[] parameter(1)
  ROOT %sum = f32[] add(%a, %b)
}

%fused (p: f32[4]) -> f32[4] {
  %p = f32[4]{0} parameter(0)
  %exp.1 = f32[4]{0} exponential(%p)
  ROOT %exp.2 = f32[4]{0} exponential(%exp.1)
}

%inner_body (s: (s32[], f32[4])) -> (s32[], f32[4]) {
  %s = (s32[], f32[4]{0}) parameter(0)
  %i = s32[] get-tuple-element(%s), index=0
  %v = f32[4]{0} get-tuple-element(%s), index=1
  %wrapped = f32[4]{0} fusion(%v), kind=kLoop, calls=%fused
  ROOT %t = (s32[], f32[4]{0}) tuple(%i, %wrapped)
}

%inner_condition (s.1: (s32[], f32[4])) -> pred[] {
  %s.1 = (s32[], f32[4]{0}) parameter(0)
  %i.1 = s32[] get-tuple-element(%s.1), index=0
  %three = s32[] constant(3)
  ROOT %less = pred[] compare(%i.1, %three), direction=LT
}

%body (s.2: (s32[], f32[4])) -> (s32[], f32[4]) {
  %s.2 = (s32[], f32[4]{0}) parameter(0)
  %loop.1 = (s32[], f32[4]{0}) while(%s.2), condition=%inner_condition, body=%inner_body, \
metadata={op_name="while(body=%fused)"}, backend_config={"known_trip_count":{"n":"3"}}
  %v.2 = f32[4]{0} get-tuple-element(%loop.1), index=1
  %i.2 = s32[] get-tuple-element(%loop.1), index=0
  %sorted = (f32[4]{0}, s32[4]{0:T(256)}) custom-call(%v.2), custom_call_target="TopK"
  %v.3 = f32[4]{0} get-tuple-element(%sorted), index=0
  ROOT %t.2 = (s32[], f32[4]{0}) tuple(%i.2, %v.3)
}

%condition (s.3: (s32[], f32[4])) -> pred[] {
  %s.3 = (s32[], f32[4]{0}) parameter(0)
  ROOT %yes = pred[] constant(true)
}

%small (p.1: f32[4]) -> f32[4] {
  ROOT %p.1 = f32[4]{0} parameter(0)
}

%large (p.2: f32[4]) -> f32[4] {
  %p.2 = f32[4]{0} parameter(0)
  %copied = f32[4]{0} copy(%p.2)
  ROOT %copied.1 = f32[4]{0} copy(%copied)
}

%called (p.3: f32[4]) -> f32[4] {
  %p.3 = f32[4]{0} parameter(0)
  ROOT %negated = f32[4]{0} fusion(%p.3), kind=kLoop, calls=%fused
}

ENTRY %main.9 (x: f32[4]) -> f32[4] {
  %x = f32[4]{0} parameter(0)
  %zero = f32[] constant(0)
  %count = s32[] constant(0)
  %none = f32[0,4]{1,0} copy(%nothing)
  %total = f32[] reduce(%x, %zero), dimensions={0}, to_apply=%add.1
  %begun = (f32[4]{0}, f32[4]{0}, u32[]) copy-start(%x)
  %done = f32[4]{0} copy-done(%begun)
  %called.1 = f32[4]{0} call(%done), to_apply=%called
  %called.2 = f32[4]{0} call(%called.1), to_apply=%called
  %all = (s32[], /*index=1*/f32[4]{0}) tuple(%count, %called.2)
  %loop = (s32[], f32[4]{0}) while(%all), condition=%condition, body=%body, \
backend_config={"known_trip_count":{"n":"8"}}
  %v.4 = f32[4]{0} get-tuple-element(%loop), index=1
  ROOT %chosen = f32[4]{0} conditional(%index, %v.4, %v.4), branch_computations={%small, %large}
}
"""


def test_a_written_program_counts_as_by_hand() -> None:
    assert kernels_in(HLO) == {
        "reduce": 1,
        "copy-start": 1,
        "conditional": 1,
        "copy": 2,  # of the larger branch
        "fusion": 2 + 8 * 3,  # two calls, eight turns of three turns
        "while": 1 + 8,
        "custom-call": 8,
        "compare": 8 * (3 + 1),
    }


def test_a_loop_of_unknown_length_turns_once() -> None:
    unknown = HLO.replace('{"known_trip_count":{"n":"8"}}', "{}")
    assert kernels_in(unknown)["fusion"] == 2 + 3


def test_another_spelling_of_choices_and_names() -> None:
    other = HLO.replace(
        "branch_computations={%small, %large}", "true_computation=small, false_computation=large"
    )
    assert kernels_in(other.replace("%", "")) == kernels_in(HLO)


def test_what_is_no_program_is_refused() -> None:
    with pytest.raises(ValueError, match="ENTRY"):
        kernels_in("HloModule jit_f\n")


def test_compiled_loops_grow_by_the_kernels_of_a_turn() -> None:
    def total(turns: int) -> int:
        def f(x: jax.Array) -> jax.Array:
            return jax.lax.fori_loop(0, turns, lambda _, y: jnp.sort(jnp.cos(y) @ x), x)

        text = jax.jit(f).lower(jnp.ones((5, 5))).compile().as_text()
        assert text is not None
        return kernels_in(text).total()

    ten, twenty, thirty = total(10), total(20), total(30)
    assert thirty - twenty == twenty - ten >= 3 * 10  # at least cosine, product and sort


def test_a_step_of_a_map_is_measured() -> None:
    subjects = suite.chosen(micro.subjects(), "micro/3m/kernels_per_step")
    assert [subject.names for subject in subjects] == [("micro/3m/kernels_per_step",)]
    (measured,) = subjects[0].measure()
    assert measured.name == "micro/3m/kernels_per_step"
    # Eight game loops of movement and combat.
    assert 8 * 10 < measured.value < 8 * 1000


def test_maps_without_goals_are_measured_on_request() -> None:
    def maps(pattern: str | None) -> set[str]:
        found = suite.chosen(micro.subjects(), pattern)
        return {name.split("/")[1] for subject in found for name in subject.names}

    assert maps(None) == set(micro.GOALS) < set(map_names())
    assert maps("micro") == maps("kernels_per_step") == set(map_names())
    assert maps("micro/corridor/") == {"corridor"}
