"""A chain of layers in an ONNX graph, as an `MLP`.

Gemm, or MatMul and Add, with activations between. Whatever scales and shifts the entries of a value on the way
(normalisation of inputs and outputs, BatchNormalization) is folded into the layer before or after it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from kpirl_ocp.ocp.models.mlp import MLP
from kpirl_ocp.ocp.models.onnx.graph import Graph, Node
from kpirl_ocp.types import Array

_ACTIVATIONS = {
    "Elu": "elu",
    "LeakyRelu": "leaky_relu",
    "Relu": "relu",
    "Sigmoid": "sigmoid",
    "Silu": "silu",  # not an operator: x * Sigmoid(x), recognised by `_merge`
    "Softplus": "softplus",
    "Tanh": "tanh",
}
_ALPHA = {"Elu": 1.0, "LeakyRelu": 0.01}  # of the activations of this package, and ONNX's defaults


def chain(graph: Graph) -> MLP | None:
    """The network, or None if the graph is not one chain of layers from its one input to its output."""
    layers = _Layers(graph.size(graph.inputs[0]))
    value = graph.inputs[0]
    for node in _merge(graph.nodes, graph.constants):
        others = [name for name in node.inputs if name and name != value]
        known = [np.asarray(graph.constants[name], float) for name in others if name in graph.constants]
        if node.inputs.count(value) != 1 or len(known) != len(others) or not layers.take(node, value, known):
            return None
        value = node.outputs[0]
    return layers.network() if value == graph.output and len(graph.inputs) == 1 else None


class _Layers:
    """The layers so far, and the scale and shift (n,) of the value since the last activation."""

    def __init__(self, n_in: int) -> None:
        self.weights: list[Array] = []
        self.biases: list[Array] = []
        self.activations: list[str] = []
        self.open = False  # the last layer has no activation yet
        self.scale, self.shift = np.ones(n_in), np.zeros(n_in)

    def take(self, node: Node, value: str, known: list[Array]) -> bool:
        """Go on with a node of this value and constants; False if no layer has such a node."""
        if node.kind in ("Gemm", "MatMul"):
            return self._linear(node, value, known)
        if node.kind in _ACTIVATIONS:
            return self._activation(node)
        affine = _AFFINE.get(node.kind)
        return affine is not None and self._affine(affine(node, value, known))

    def network(self) -> MLP:
        """The network of the collected layers."""
        if not self.open and (not self.weights or (self.scale != 1).any() or (self.shift != 0).any()):
            self._append(np.eye(len(self.scale)), np.zeros(len(self.scale)))
        return MLP(tuple(self.weights), tuple(self.biases), tuple(self.activations))

    def _linear(self, node: Node, value: str, known: list[Array]) -> bool:
        """X B, or alpha X B + beta C."""
        flags = {"alpha": 1.0, "beta": 1.0, "transA": 0, "transB": 0} | node.attributes
        if node.inputs[0] != value or flags["transA"] or known[0].ndim != 2:
            return False
        weight = flags["alpha"] * (known[0] if flags["transB"] else known[0].T)
        bias = flags["beta"] * known[1].ravel() if len(known) > 1 else 0.0
        self._append(weight, np.broadcast_to(bias, len(weight)))
        return True

    def _append(self, weight: Array, bias: Array) -> None:
        """One more layer, which takes the scale and shift along."""
        if self.open:
            self.scale, self.shift = np.ones(weight.shape[1]), np.zeros(weight.shape[1])
        self.weights.append(weight * self.scale)
        self.biases.append(bias + weight @ self.shift)
        self.activations.append("identity")
        self.scale, self.shift = np.ones(len(weight)), np.zeros(len(weight))
        self.open = True

    def _activation(self, node: Node) -> bool:
        expected = _ALPHA.get(node.kind, 0.0)
        if not np.isclose(node.attributes.get("alpha", expected), expected, rtol=1e-6):
            return False
        if not self.open:
            self._append(np.eye(len(self.scale)), np.zeros(len(self.scale)))
        self.activations[-1] = _ACTIVATIONS[node.kind]
        self.open = False
        return True

    def _affine(self, change: tuple[Array, Array] | None) -> bool:
        """scale * value + shift."""
        if change is None:
            return False
        width = len(self.biases[-1]) if self.open else len(self.scale)
        try:
            scale, shift = (np.broadcast_to(part.ravel() if part.size > 1 else part.item(), width) for part in change)
        except ValueError:  # a constant of another length: the result is no vector of this width
            return False
        if self.open:
            self.weights[-1] = scale[:, None] * self.weights[-1]
            self.biases[-1] = scale * self.biases[-1] + shift
        else:
            self.scale, self.shift = scale * self.scale, scale * self.shift + shift
        return True


def _add(node: Node, value: str, known: list[Array]) -> tuple[Array, Array]:
    return np.ones(1), known[0]


def _subtract(node: Node, value: str, known: list[Array]) -> tuple[Array, Array]:
    first = node.inputs[0] == value
    return np.full(1, 1.0 if first else -1.0), -known[0] if first else known[0]


def _multiply(node: Node, value: str, known: list[Array]) -> tuple[Array, Array]:
    return known[0], np.zeros(1)


def _divide(node: Node, value: str, known: list[Array]) -> tuple[Array, Array] | None:
    return (1 / known[0], np.zeros(1)) if node.inputs[0] == value and known[0].all() else None


def _keep(node: Node, value: str, known: list[Array]) -> tuple[Array, Array]:
    return np.ones(1), np.zeros(1)


def batch_normalisation(node: Node, value: str, known: list[Array]) -> tuple[Array, Array] | None:
    """scale / sqrt(var + epsilon), and the shift that goes with it, of the statistics of training."""
    if len(known) != 4 or node.attributes.get("training_mode", 0):
        return None
    scale, bias, mean, variance = known
    gain = scale / np.sqrt(variance + node.attributes.get("epsilon", 1e-5))
    return gain, bias - gain * mean


_AFFINE: dict[str, Callable[[Node, str, list[Array]], tuple[Array, Array] | None]] = {
    "Add": _add,
    "BatchNormalization": batch_normalisation,
    "Div": _divide,
    "Identity": _keep,
    "Mul": _multiply,
    "Sub": _subtract,
}


def _merge(nodes: list[Node], constants: dict[str, Array]) -> list[Node]:
    """Nodes that together make one activation, as one."""
    merged: list[Node] = []
    for node in nodes:
        merged.append(node)
        silu, softplus = _silu(merged[-2:]), _softplus(merged[-3:], constants)
        if silu:
            merged[-2:] = [silu]
        elif softplus:
            merged[-3:] = [softplus]
    return merged


def _silu(nodes: list[Node]) -> Node | None:
    """x * Sigmoid(x)."""
    if [node.kind for node in nodes] != ["Sigmoid", "Mul"]:
        return None
    gate, product = nodes
    same = sorted(product.inputs) == sorted(gate.inputs + gate.outputs)
    return Node("Silu", gate.inputs, product.outputs, {}) if same else None


def _softplus(nodes: list[Node], constants: dict[str, Array]) -> Node | None:
    """Where(x > 20, x, Softplus(x)), as torch writes it: the two differ by 2e-9 there."""
    if [node.kind for node in nodes] != ["Softplus", "Greater", "Where"]:
        return None
    plain, large, choice = nodes
    threshold = constants.get(large.inputs[1])
    if large.inputs[0] != plain.inputs[0] or threshold is None or not (np.asarray(threshold, float) >= 20).all():
        return None
    same = choice.inputs == [large.outputs[0], plain.inputs[0], plain.outputs[0]]
    return Node("Softplus", plain.inputs, choice.outputs, {}) if same else None
