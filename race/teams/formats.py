"""The files of exported teams: written, and read back as a stranger would.

Each writer turns a `Portable` into bytes; each reader turns bytes into a function of named numpy
arrays, by the very means that a user of the file has: onnxruntime, `jax.export`, safetensors.
"""

import json
from collections.abc import Callable
from importlib.metadata import version
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import export as jax_export
from numpy.typing import NDArray
from safetensors.numpy import load, save

from race.errors import ConfigError
from race.teams.onnx_graph import onnx_model
from race.teams.portable import Portable, joint_action, next_actions
from race.types import EnvSpec

Format = Literal["onnx", "stablehlo", "numpy"]
Named = dict[str, NDArray[Any]]
Function = Callable[[Named], Named]

SUFFIXES: dict[str, str] = {"onnx": ".onnx", "stablehlo": ".stablehlo", "numpy": ".safetensors"}
PLATFORMS = ("cpu", "cuda", "tpu")
"""For which StableHLO is lowered."""


class Signature(NamedTuple):
    """What goes in and what comes out: shapes without the batch, and types."""

    inputs: dict[str, tuple[tuple[int, ...], str]]
    outputs: dict[str, tuple[tuple[int, ...], str]]


def signature(team: Portable, single: bool) -> Signature:
    """Inputs and outputs of a team, or of one agent, which has no axis ``N``."""
    spec = team.spec
    agents = () if single else (spec.n_agents,)
    obs = {"obs": ((*agents, spec.obs_size), "float32")}
    if isinstance(spec, EnvSpec):
        return Signature(obs, {"action": ((spec.joint_action_size,), "float32")})
    memory = ((*agents, team.memory_size), "float32")
    available = ((*agents, spec.n_actions), "bool")
    return Signature(
        {**obs, "memory": memory, "avail_actions": available},
        {"action": (agents, "int32"), "next_memory": memory},
    )


def computed(xp: Any, team: Portable, single: bool) -> Callable[..., tuple[Any, ...]]:
    """The function of a team over the inputs of its signature, in their order."""
    # Constants of the function, in the type of whoever computes it.
    arrays = {name: xp.asarray(array) for name, array in team.arrays.items()}

    def alone(x: Any) -> Any:
        return x[:, None] if single else x

    def of_agents(x: Any) -> Any:
        return x[:, 0] if single else x

    def joint(obs: Any) -> tuple[Any, ...]:
        return (joint_action(xp, arrays, team.layer_norm, alone(obs)),)

    def remembered(obs: Any, memory: Any, avail_actions: Any) -> tuple[Any, ...]:
        given = (alone(obs), alone(memory), alone(avail_actions))
        action, after = next_actions(xp, arrays, team.layer_norm, *given)
        return of_agents(action), of_agents(after)

    return joint if isinstance(team.spec, EnvSpec) else remembered


def written(team: Portable, kind: Format, single: bool) -> bytes:
    """The file of a team.

    Raises:
        ConfigError: if a package is missing.
    """
    if kind == "onnx":
        return onnx_model(team, single)
    if kind == "numpy":
        sizes = {"layer_norm": str(int(team.layer_norm)), "format": "race-team"}
        return bytes(save(team.arrays, metadata=sizes))
    (batch,) = jax_export.symbolic_shape("batch")
    inputs = signature(team, single).inputs.values()
    shapes = [jax.ShapeDtypeStruct((batch, *shape), np.dtype(dtype)) for shape, dtype in inputs]
    exporting = jax_export.export(jax.jit(computed(jnp, team, single)), platforms=PLATFORMS)
    return bytes(exporting(*shapes).serialize())


def read(content: bytes, kind: Format, team: Portable, single: bool) -> Function:
    """The function that a file holds; ``team`` says only what goes in and comes out.

    Raises:
        ConfigError: if a package is missing.
    """
    inputs, outputs = signature(team, single)
    run: Callable[..., Any]
    if kind == "onnx":
        try:
            import onnxruntime
        except ImportError as error:
            raise ConfigError(
                "ONNX is checked with onnxruntime: pip install 'race-marl[onnx]'"
            ) from error
        session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
        return lambda named: dict(zip(outputs, session.run(list(outputs), named), strict=True))
    if kind == "numpy":
        run = computed(np, team._replace(arrays=load(content)), single)
    else:
        run = jax_export.deserialize(bytearray(content)).call

    def function(named: Named) -> Named:
        found = run(*(named[name] for name in inputs))
        return {name: np.asarray(one) for name, one in zip(outputs, found, strict=True)}

    return function


def made_with(kind: Format) -> dict[str, str]:
    """Versions of what wrote and read a file."""
    packages = {"onnx": ("onnx", "onnxruntime"), "stablehlo": ("jax",), "numpy": ("safetensors",)}
    return {name: version(name) for name in packages[kind]} | {"numpy": version("numpy")}


def card_text(card: dict[str, Any]) -> str:
    """A card as it is written."""
    return json.dumps(card, indent=2) + "\n"
