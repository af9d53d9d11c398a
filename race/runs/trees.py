"""Pytrees as named arrays and back: what a checkpoint holds of a state."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from race.errors import CheckpointError

_STORABLE = {
    *("bool", "bfloat16", "float16", "float32", "float64"),
    *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
}


def flatten(tree: Any) -> dict[str, NDArray[Any]]:
    """The arrays of a pytree by the names of their places (`jax.tree_util.keystr`).

    Typed PRNG keys become their key data. Leaves that are functions, such as the activation of
    an equinox module, carry no state and are left out. Arrays may share memory with the tree.

    Raises:
        TypeError: for a leaf that is neither an array nor a function, or of a dtype that
            safetensors cannot hold. Python numbers are such leaves: their dtype is not defined.
    """
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {
        jax.tree_util.keystr(path): _host(jax.tree_util.keystr(path), leaf)
        for path, leaf in leaves
        if not callable(leaf)
    }


def restore(template: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    """A tree like ``template`` with the values of ``arrays``, which `flatten` made.

    Each leaf becomes what it is in the template (JAX array, typed key, numpy array, function).

    Raises:
        CheckpointError: if names, shapes or dtypes differ from the template's; names the leaf.
        TypeError: if the template cannot be flattened.
    """
    expected = flatten(template)
    for name in [*expected, *arrays]:
        if name not in arrays or name not in expected:
            has, lacks = ("run", "checkpoint") if name in expected else ("checkpoint", "run")
            raise CheckpointError(_misfit(f"the {has} has an array {name} that the {lacks} lacks"))
        saved, wanted = arrays[name], expected[name]
        if (saved.shape, saved.dtype) != (wanted.shape, wanted.dtype):
            raise CheckpointError(
                _misfit(
                    f"the array {name} is {saved.dtype}{list(saved.shape)} in the checkpoint and "
                    f"{wanted.dtype}{list(wanted.shape)} in the run"
                )
            )

    def value(path: Any, leaf: Any) -> Any:
        return leaf if callable(leaf) else _like(leaf, arrays[jax.tree_util.keystr(path)])

    return jax.tree_util.tree_map_with_path(value, template)


def blank(shapes: Any) -> Any:
    """Zeros, without memory of their own, for the shapes that `jax.eval_shape` tells."""
    return jax.tree.map(
        lambda leaf: leaf if callable(leaf) else np.broadcast_to(leaf.dtype.type(0), leaf.shape),
        shapes,
    )


def _host(name: str, leaf: Any) -> NDArray[Any]:
    if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        leaf = jax.random.key_data(leaf)
    if not isinstance(leaf, jax.Array | np.ndarray | np.generic):
        raise TypeError(f"the leaf {name} is a {type(leaf).__name__}; make it an array")
    if leaf.dtype.name not in _STORABLE:
        raise TypeError(f"the leaf {name} is of dtype {leaf.dtype}, which cannot be stored")
    return np.asarray(leaf)


def _like(leaf: Any, value: NDArray[Any]) -> Any:
    if isinstance(leaf, np.generic):
        return value[()]
    if isinstance(leaf, np.ndarray):
        return value.copy()
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(jnp.array(value), impl=jax.random.key_impl(leaf))
    return jnp.array(value)


def _misfit(difference: str) -> str:
    return (
        f"The checkpoint does not fit this run: {difference}. It was written with another "
        "configuration or another version of race; resume with the ones that wrote it (config.json "
        "and metadata.json of the run directory tell which)."
    )
