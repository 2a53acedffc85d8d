"""A multilayer perceptron from an ONNX file, read with the `onnx` package (an optional dependency).

CasADi reads ONNX too (`GraphBuilder(path).create(name, {"symbolic": True})`), but as one expression in which layers can
no longer be told apart; what this package gains from a network, it gains from its layers.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from kpirl_ocp.errors import ModelError, ProblemError
from kpirl_ocp.ocp.models.mlp import MLP
from kpirl_ocp.types import Array

_ACTIVATIONS = {
    "Elu": "elu",
    "Identity": "identity",
    "LeakyRelu": "leaky_relu",
    "Relu": "relu",
    "Sigmoid": "sigmoid",
    "Silu": "silu",  # not an operator: x * Sigmoid(x), recognised by `_merge_silu`
    "Softplus": "softplus",
    "Tanh": "tanh",
}
_ALPHA = {"Elu": 1.0, "LeakyRelu": 0.01}  # of the activations of this package, and ONNX's defaults
_SUPPORTED = "Gemm, MatMul, Add, Elu, Identity, LeakyRelu, Relu, Sigmoid, Softplus, Tanh and Mul in x * Sigmoid(x)"


def load_onnx(path: str | Path) -> MLP:
    """The network of an ONNX graph that is one chain of Gemm, or MatMul and Add, with activations between.

    Raises:
        ModelError: the file cannot be read, `onnx` is not installed, or the graph holds anything else; it names the
            operator.
    """
    try:
        onnx: Any = import_module("onnx")
    except ImportError as error:
        raise ModelError("reading ONNX files needs the package onnx: pip install onnx.") from error
    try:
        graph = onnx.load(str(path)).graph
    except Exception as error:  # of onnx, protobuf or the file system
        raise ModelError(f"{path} cannot be read as ONNX: {error}") from error
    constants = {tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in graph.initializer}
    nodes = []
    for node in graph.node:
        attributes = {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}
        if node.op_type == "Constant" and "value" in attributes:
            constants[node.output[0]] = onnx.numpy_helper.to_array(attributes["value"])
        else:
            nodes.append(_Node(node.op_type, list(node.input), list(node.output), attributes))
    ends = [value.name for value in graph.input if value.name not in constants], [value.name for value in graph.output]
    try:
        return _network(_merge_silu(nodes), constants, *ends)
    except ProblemError as error:
        raise ModelError(f"{path}: {error}") from error


@dataclass(frozen=True)
class _Node:
    kind: str
    inputs: list[str]
    outputs: list[str]
    attributes: dict[str, Any]


def _merge_silu(nodes: list[_Node]) -> list[_Node]:
    """Sigmoid and Mul that make x * Sigmoid(x) as one node "Silu"."""
    merged: list[_Node] = []
    for node in nodes:
        gate = merged[-1] if merged and merged[-1].kind == "Sigmoid" else None
        if gate and node.kind == "Mul" and sorted(node.inputs) == sorted(gate.inputs + gate.outputs):
            merged[-1] = _Node("Silu", gate.inputs, node.outputs, {})
        else:
            merged.append(node)
    return merged


def _network(nodes: list[_Node], constants: dict[str, Array], inputs: list[str], outputs: list[str]) -> MLP:
    """The layers along the chain that leads from the one input to the one output."""
    weights: list[Array] = []
    biases: list[Array] = []
    activations: list[str | None] = []  # None while the layer may still get a bias or an activation
    value = inputs[0] if len(inputs) == 1 else None
    for node in nodes:
        others = [name for name in node.inputs if name and name != value]
        if node.kind not in ("Gemm", "MatMul", "Add", *_ACTIVATIONS):
            raise ProblemError(f"operator {node.kind} is not supported; supported are {_SUPPORTED}.")
        if value not in node.inputs or not all(name in constants for name in others):
            raise ProblemError(f"operator {node.kind} does not continue a single chain of layers from the input.")
        known = [np.asarray(constants[name], float) for name in others]
        if node.kind in ("Gemm", "MatMul") and node.inputs[0] == value and known[0].ndim == 2:
            weight, bias = _linear(node, known)
            weights.append(weight)
            biases.append(bias)
            activations = [name or "identity" for name in activations] + [None]
        elif node.kind == "Add" and activations[-1:] == [None]:
            biases[-1] = biases[-1] + known[0].ravel()
        elif node.kind in _ACTIVATIONS and activations[-1:] == [None]:
            _check_alpha(node)
            activations[-1] = _ACTIVATIONS[node.kind] if node.kind != "Identity" else None
        else:
            raise ProblemError(f"operator {node.kind} stands where no layer of a plain network has it.")
        value = node.outputs[0]
    if outputs != [value]:
        raise ProblemError(f"a network has one input and one output; the graph has {inputs} and {outputs}.")
    return MLP(tuple(weights), tuple(biases), tuple(name or "identity" for name in activations))


def _linear(node: _Node, known: list[Array]) -> tuple[Array, Array]:
    """Weight (n_out, n_in) and bias of x B, or of alpha x B + beta C."""
    flags = {"alpha": 1.0, "beta": 1.0, "transA": 0, "transB": 0} | node.attributes
    if flags["transA"]:
        raise ProblemError(f"operator {node.kind} with transA is not supported.")
    weight = flags["alpha"] * (known[0] if flags["transB"] else known[0].T)
    bias = np.zeros(len(weight))
    return weight, bias + flags["beta"] * known[1].ravel() if len(known) > 1 else bias


def _check_alpha(node: _Node) -> None:
    expected = _ALPHA.get(node.kind, 0.0)
    found = node.attributes.get("alpha", expected)
    if not np.isclose(found, expected, rtol=1e-6):
        raise ProblemError(f"operator {node.kind} has alpha = {found:g}; only {expected:g} is supported.")
