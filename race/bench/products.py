"""The matrix products of a compiled program, and a program of these alone.

The time of an update divided by the time of its matrix products says how much is lost to
everything else, whatever the machine.
"""

import math
import re
from collections.abc import Callable, Sequence
from functools import partial
from itertools import groupby
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from race.bench.kernels import executions, name_of_computation

_SHAPE = r"(\w+)\[([\d,]*)\]"
_DEFINITION = re.compile(rf"^\s*(?:ROOT )?%?([\w.\-]+) = {_SHAPE}")
_PARAMETER = re.compile(rf"%?([\w.\-]+): {_SHAPE}")
_DOT = re.compile(r" dot\(([^()]*)\)(.*)$")
_OPERAND = re.compile(r"%?([\w.\-]+)$")
_LOOP = 8
_DTYPES = {"f16": "float16", "bf16": "bfloat16", "f32": "float32", "f64": "float64"}


class Product(NamedTuple):
    """One matrix product: shapes and what `jax.lax.dot_general` calls dimension numbers."""

    dtype: str
    left: tuple[int, ...]
    right: tuple[int, ...]
    contracting: tuple[tuple[int, ...], tuple[int, ...]]
    batch: tuple[tuple[int, ...], tuple[int, ...]]

    @property
    def operations(self) -> int:
        """Floating-point operations, a multiplication and an addition counted as two."""
        shared = math.prod(self.right[axis] for axis in (*self.contracting[1], *self.batch[1]))
        return 2 * math.prod(self.left) * math.prod(self.right) // shared


def products_in(hlo: str) -> list[Product]:
    """Every matrix product of a compiled program, as often as it is carried out.

    Args:
        hlo: what ``jax.jit(f).lower(...).compile().as_text()`` returns.

    Raises:
        ValueError: if an operand of a product is defined nowhere in its computation.
    """
    found: list[Product] = []
    shapes: dict[str, tuple[str, tuple[int, ...]]] = {}
    times, count = executions(hlo), 0
    for line in hlo.splitlines():
        if line.endswith("{") and not line.startswith(" "):
            # The head of a computation: names are its own from here on.
            count = times.get(name_of_computation(line) or "", 0)
            shapes = {name: (dtype, _sizes(s)) for name, dtype, s in _PARAMETER.findall(line)}
            continue
        if definition := _DEFINITION.match(line):
            name, dtype, sizes = definition.groups()
            shapes[name] = (dtype, _sizes(sizes))
        if dot := _DOT.search(line):
            found += count * [_product(dot[1], dot[2], shapes)]
    return found


def _product(
    operands: str, attributes: str, shapes: dict[str, tuple[str, tuple[int, ...]]]
) -> Product:
    # Operands may be written with their types, `f32[2,3]{1,0} %name`, whose commas are in brackets.
    names = [
        match[1]
        for operand in re.split(r",\s*(?![^\[{]*[\]}])", operands)
        if (match := _OPERAND.search(operand.strip()))
    ]
    if len(names) != 2 or not all(name in shapes for name in names):
        raise ValueError(f"The operands of dot({operands}) are not defined before it.")

    def axes(side: str, kind: str) -> tuple[int, ...]:
        match = re.search(rf"{side}_{kind}_dims={{([\d,]*)}}", attributes)
        return _sizes(match[1]) if match else ()

    (dtype, left), (_, right) = (shapes[name] for name in names)
    return Product(
        _DTYPES[dtype],
        left,
        right,
        (axes("lhs", "contracting"), axes("rhs", "contracting")),
        (axes("lhs", "batch"), axes("rhs", "batch")),
    )


def _sizes(text: str) -> tuple[int, ...]:
    return tuple(int(size) for size in text.split(",") if size)


class Operands(NamedTuple):
    """One array for each shape of a left operand, and one for each of a right operand."""

    left: dict[str, Array]
    right: dict[str, Array]


def random_operands(products: Sequence[Product]) -> Operands:
    """Operands for all products, with values that stay finite in `run_products`."""
    rng = np.random.default_rng(0)

    def random(shape: tuple[int, ...], dtype: str) -> Array:
        return jnp.asarray(rng.uniform(-1, 1, shape), dtype)

    return Operands(
        {_kind(p.left, p.dtype): random(p.left, p.dtype) for p in products},
        {_kind(p.right, p.dtype): random(p.right, p.dtype) for p in products},
    )


def _kind(shape: tuple[int, ...], dtype: str) -> str:
    return f"{dtype}{list(shape)}"


@partial(jax.jit, static_argnames="products", donate_argnames="operands")
def run_products(
    operands: Operands, repetitions: Array, *, products: tuple[Product, ...]
) -> Operands:
    """Computes every product ``repetitions`` times and nothing else.

    The compiler may drop a product that nobody reads, narrow one of which only a part is read,
    merge equal ones and move one out of the loop whose operands never change. So the operands are
    carried by the loop, and after each product one number of it, behind a barrier that hides that
    it is only one, is written in place into its left operand: a few bytes per product.

    Products of the same shapes use the same arrays. In an update, too, operands were written or
    read shortly before and are near in the caches; with arrays of their own, the products alone
    can take longer than the update.
    """

    def body(_: Array, operands: Operands) -> Operands:
        left = dict(operands.left)
        for product, equal in groupby(products):
            mine = _kind(product.left, product.dtype)
            right = operands.right[_kind(product.right, product.dtype)]
            once = partial(_once, product, right)
            count = len(list(equal))  # of a loop's turns; as many copies would take long to compile
            if count < _LOOP:
                for _turn in range(count):
                    left[mine] = once(left[mine])
            else:
                left[mine] = _repeated(once, count, left[mine])
        return Operands(left, operands.right)

    return jax.lax.fori_loop(0, repetitions, body, operands)


def _repeated(once: Callable[[Array], Array], count: int, left: Array) -> Array:
    repeated: Array = jax.lax.fori_loop(0, count, lambda _, x: once(x), left)
    return repeated


def _once(product: Product, right: Array, left: Array) -> Array:
    result = jax.lax.dot_general(left, right, (product.contracting, product.batch))
    result = jax.lax.optimization_barrier(result)
    number = jnp.tanh(result[(0,) * result.ndim])
    return left.at[(0,) * left.ndim].set(number, mode="promise_in_bounds")


def products_alone(products: Sequence[Product]) -> Callable[[int], Any]:
    """A function that computes all the products a given number of times."""
    operands = random_operands(products)

    def run(repetitions: int) -> Any:
        nonlocal operands
        operands = run_products(operands, np.int32(repetitions), products=tuple(products))
        return operands

    return run


def operations(products: Sequence[Product]) -> int:
    """Floating-point operations of all the products together."""
    return sum(product.operations for product in products)
