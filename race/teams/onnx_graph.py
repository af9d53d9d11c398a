"""A team as an ONNX graph, written node by node.

The networks are a handful of products and activations, so the graph is made of these; it needs
the package onnx alone (a converter from JAX would need some forty more), and every node in it has
a reason.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from race.errors import ConfigError
from race.method.normalisation import CLIP
from race.networks.dense import VARIANCE_FLOOR
from race.teams.portable import UNAVAILABLE, Portable
from race.types import EnvSpec

OPSET = 17
IR_VERSION = 8
"""Old enough for runtimes from 2022 on."""


def onnx_model(team: Portable, single: bool) -> bytes:
    """The file of a team, whose batch may be of any size.

    Args:
        team: the team.
        single: whether it is one agent whose inputs and outputs have no axis ``N``.

    Raises:
        ConfigError: if onnx is not installed.
    """
    try:
        import onnx
    except ImportError as error:
        raise ConfigError("ONNX needs a package: pip install 'race-marl[onnx]'") from error
    graph = _Graph(onnx, team, single)
    graph.build()
    return bytes(graph.model().SerializeToString())


class _Graph:
    def __init__(self, onnx: Any, team: Portable, single: bool) -> None:
        self._onnx, self._team, self._single = onnx, team, single
        self._nodes: list[Any] = []
        self._constants: dict[str, NDArray[Any]] = {}
        self._inputs: list[Any] = []
        self._outputs: list[Any] = []

    def build(self) -> None:
        """Nodes, inputs and outputs."""
        spec = self._team.spec
        if isinstance(spec, EnvSpec):
            obs = self._shown(self._input("obs", (spec.n_agents, spec.obs_size)))
            self._joint_action(self._node("Transpose", obs, perm=[1, 0, 2]))
        else:
            obs = self._shown(self._input("obs", (spec.n_agents, spec.obs_size)))
            memory = self._input("memory", (spec.n_agents, self._team.memory_size))
            available = self._input("avail_actions", (spec.n_agents, spec.n_actions), "BOOL")
            obs, memory = (self._node("Transpose", x, perm=[1, 0, 2]) for x in (obs, memory))
            self._next_actions(obs, memory, available)

    def model(self) -> Any:
        """The whole, checked by onnx itself."""
        helper = self._onnx.helper
        held = [
            self._onnx.numpy_helper.from_array(np.ascontiguousarray(array), name)
            for name, array in self._constants.items()
        ]
        graph = helper.make_graph(self._nodes, "team", self._inputs, self._outputs, held)
        opset = [helper.make_opsetid("", OPSET)]
        model = helper.make_model(
            graph, opset_imports=opset, producer_name="race", ir_version=IR_VERSION
        )
        self._onnx.checker.check_model(model, full_check=True)
        return model

    def _joint_action(self, x: str) -> None:
        """As `race.teams.portable.joint_action`."""
        arrays, spec = self._team.arrays, self._team.spec
        for layer in ("hidden", "out"):
            x = self._node("Tanh", self._normalised(self._layer(layer, x)))
        x = self._node("Tanh", self._layer("head", x))
        size = spec.n_agents * arrays["head.bias"].shape[1]
        x = self._node("Transpose", x, perm=[1, 0, 2])
        flat = self._node("Reshape", x, self._constant("flat", np.array([-1, size])))
        chosen = self._node("Gather", flat, self._constant("joint", arrays["joint"]), axis=1)
        low, high = (self._constant(name, arrays[name][None]) for name in ("low", "high"))
        half = self._constant("half", np.array(0.5, np.float32))
        one = self._constant("one", np.array(1, np.float32))
        extent = self._constant("extent", (arrays["high"] - arrays["low"])[None])
        share = self._node("Mul", self._node("Add", chosen, one), half)
        shifted = self._node("Add", low, self._node("Mul", share, extent))
        shifted = self._node("Max", self._node("Min", shifted, high), low)
        around = self._constant("around_0", (arrays["low"] == -arrays["high"])[None])
        action = self._node("Where", around, self._node("Mul", chosen, high), shifted)
        self._output("action", action, (len(arrays["joint"]),))

    def _next_actions(self, obs: str, memory: str, available: str) -> None:
        """As `race.teams.portable.next_actions`."""
        spec, size = self._team.spec, self._team.arrays["head.weight"].shape[1]
        agents = spec.n_agents
        carry = self._part(memory, 0, size)
        last = self._part(memory, size, self._team.memory_size)
        x = self._node("MatMul", last, self._weight("action"))
        x = self._node("Add", x, self._layer("obs", obs))
        x = self._node("Relu", self._normalised(x))
        into, own = self._layer("into", x), self._layer("memory", carry)
        parts = [(gate * size, (gate + 1) * size) for gate in range(3)]
        reset, update = (
            self._node("Sigmoid", self._node("Add", self._part(into, *p), self._part(own, *p)))
            for p in parts[:2]
        )
        gated = self._node("Mul", reset, self._part(own, *parts[2]))
        candidate = self._node("Tanh", self._node("Add", self._part(into, *parts[2]), gated))
        moved = self._node("Mul", update, self._node("Sub", carry, candidate))
        carry = self._node("Add", candidate, moved)
        scores = self._node("Transpose", self._layer("head", carry), perm=[1, 0, 2])
        never = self._constant("never", np.array(UNAVAILABLE))
        masked = self._node("Where", available, scores, never)
        action = self._node("ArgMax", masked, axis=2, keepdims=1)  # [B, N, 1]
        every = self._constant("actions", np.arange(self._team.arrays["head.bias"].shape[1]))
        chosen = self._node("Equal", action, every)
        one_hot = self._node("Cast", chosen, to=self._onnx.TensorProto.FLOAT)
        after = self._node("Transpose", carry, perm=[1, 0, 2])
        memory = self._node("Concat", after, one_hot, axis=2)
        place = self._constant("last_axis", np.array([2]))
        action = self._node("Squeeze", action, place)
        action = self._node("Cast", action, to=self._onnx.TensorProto.INT32)
        self._output("action", action, () if self._single else (agents,), "INT32")
        self._output("next_memory", memory, (agents, self._team.memory_size))

    def _input(self, name: str, shape: tuple[int, ...], kind: str = "FLOAT") -> str:
        shown = shape[1:] if self._single else shape
        self._inputs.append(self._value(name, shown, kind))
        if not self._single:
            return name
        return self._node("Unsqueeze", name, self._constant("agents_axis", np.array([1])))

    def _output(self, name: str, value: str, shape: tuple[int, ...], kind: str = "FLOAT") -> None:
        # The joint action of a team, or of an agent alone, has no axis of agents.
        if self._single and name != "action":
            value = self._node("Squeeze", value, self._constant("agents_axis", np.array([1])))
            shape = shape[1:]
        if self._single and kind == "INT32":
            value = self._node("Squeeze", value, self._constant("agents_axis", np.array([1])))
        self._nodes.append(self._onnx.helper.make_node("Identity", [value], [name]))
        self._outputs.append(self._value(name, shape, kind))

    def _value(self, name: str, shape: tuple[int, ...], kind: str) -> Any:
        dtype = getattr(self._onnx.TensorProto, kind)
        return self._onnx.helper.make_tensor_value_info(name, dtype, ["batch", *shape])

    def _node(self, operation: str, *inputs: str, **attributes: Any) -> str:
        name = f"{operation.lower()}_{len(self._nodes)}"
        node = self._onnx.helper.make_node(operation, list(inputs), [name], **attributes)
        self._nodes.append(node)
        return name

    def _constant(self, name: str, value: NDArray[Any]) -> str:
        self._constants[name] = value
        return name

    def _weight(self, layer: str) -> str:
        name = f"{layer}.weight"
        return self._constant(name, self._team.arrays[name])

    def _layer(self, layer: str, x: str) -> str:
        bias = self._constant(f"{layer}.bias", self._team.arrays[f"{layer}.bias"][:, None])
        return self._node("Add", self._node("MatMul", x, self._weight(layer)), bias)

    def _part(self, x: str, start: int, stop: int) -> str:
        """Entries of the last axis."""
        ends = (self._constant(f"at_{place}", np.array([place])) for place in (start, stop))
        return self._node("Slice", x, *ends, self._constant("last_axis", np.array([2])))

    def _shown(self, obs: str) -> str:
        """As `race.teams.portable` has it."""
        if "obs.mean" not in self._team.arrays:
            return obs
        names = ("obs.mean", "obs.factor")
        mean, factor = (self._constant(name, self._team.arrays[name][None]) for name in names)
        apart = self._node("Mul", self._node("Sub", obs, mean), factor)
        low, high = (
            self._constant(f"clip_{name}", np.array(bound, np.float32))
            for name, bound in (("low", -CLIP), ("high", CLIP))
        )
        return self._node("Clip", apart, low, high)

    def _normalised(self, x: str) -> str:
        if not self._team.layer_norm:
            return x
        centred = self._node("Sub", x, self._node("ReduceMean", x, axes=[-1], keepdims=1))
        square = self._node("Mul", centred, centred)
        variance = self._node("ReduceMean", square, axes=[-1], keepdims=1)
        floor = self._constant("variance_floor", np.array(VARIANCE_FLOOR, np.float32))
        spread = self._node("Sqrt", self._node("Add", variance, floor))
        return self._node("Div", centred, spread)
