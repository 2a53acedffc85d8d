"""The graph of an ONNX model for one point: nodes, constants, and the shape of every value."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.types import Array


@dataclass(frozen=True)
class Node:
    """One operator; unused optional inputs have empty names."""

    kind: str
    inputs: list[str]
    outputs: list[str]
    attributes: dict[str, Any]


@dataclass(frozen=True)
class Graph:
    """A network with one output.

    model: the ONNX model, its dynamic axes fixed to 1.
    nodes: in the order of their evaluation, without constants.
    constants: by name.
    shapes: of inputs and intermediate values, where ONNX can tell.
    """

    model: Any
    nodes: list[Node]
    constants: dict[str, Array]
    shapes: dict[str, tuple[int, ...]]
    inputs: list[str]
    output: str

    @classmethod
    def of_model(cls, model: Any) -> Graph:
        """Raises ProblemError for a model that ONNX finds invalid, or with more than one point or output."""
        onnx: Any = import_module("onnx")
        constants = {t.name: onnx.numpy_helper.to_array(t) for t in model.graph.initializer}
        inputs = [value for value in model.graph.input if value.name not in constants]
        for value in inputs:
            _fix_dynamic_axes(value)
        try:
            onnx.checker.check_model(model)
            inferred = onnx.shape_inference.infer_shapes(model, strict_mode=True)
        except (onnx.checker.ValidationError, onnx.shape_inference.InferenceError) as error:
            raise ProblemError(f"the graph is not valid: {' '.join(str(error).split())}") from error
        outputs = [value.name for value in model.graph.output]
        if len(outputs) != 1 or not inputs:
            raise ProblemError(f"a network has inputs and one output; the graph has outputs {', '.join(outputs)}.")
        values = [*inputs, *inferred.graph.value_info, *inferred.graph.output]
        shapes = {value.name: _shape(value) for value in values}
        for value in inputs:
            _check_one_point(value.name, shapes[value.name])
        nodes = []
        for node in model.graph.node:
            attributes = {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}
            if node.op_type == "Constant" and "value" in attributes:
                constants[node.output[0]] = onnx.numpy_helper.to_array(attributes["value"])
            elif node.op_type == "Identity" and node.input[0] in constants:  # torch writes equal weights once
                constants[node.output[0]] = constants[node.input[0]]
            else:
                nodes.append(Node(node.op_type, list(node.input), list(node.output), attributes))
        return cls(model, nodes, constants, shapes, [value.name for value in inputs], outputs[0])

    def size(self, name: str) -> int:
        """Length of the last axis of a value. Raises ProblemError where ONNX cannot tell."""
        shape = self.constants[name].shape if name in self.constants else self.shapes.get(name, ())
        if not shape:
            raise ProblemError(f"the shape of {name!r} is not known.")
        return shape[-1]


def _fix_dynamic_axes(value: Any) -> None:
    for axis in value.type.tensor_type.shape.dim:
        if axis.dim_value <= 0:
            axis.dim_value = 1


def _shape(value: Any) -> tuple[int, ...]:
    return tuple(axis.dim_value or 1 for axis in value.type.tensor_type.shape.dim)


def _check_one_point(name: str, shape: tuple[int, ...]) -> None:
    if not 1 <= len(shape) <= 2 or int(np.prod(shape[:-1])) != 1:
        raise ProblemError(f"input {name!r} must have the shape (1, n) of one point, got {shape}.")
