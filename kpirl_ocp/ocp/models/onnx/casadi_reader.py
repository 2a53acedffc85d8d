"""Any ONNX graph in CasADi, by CasADi's own reader.

Operators that the reader does not know are rewritten as ones it knows. Then results are compared with those of ONNX's
reference implementation, because a reader that confuses two axes does not say so.
"""

from __future__ import annotations

import contextlib
import io
import re
import tempfile
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.models.graph_network import GraphNetwork
from kpirl_ocp.ocp.models.onnx.chain import batch_normalisation
from kpirl_ocp.ocp.models.onnx.graph import Graph, Node
from kpirl_ocp.ocp.problem.guards import dense

_AGREEMENT = 1e-4  # with the reference, which computes in the file's float32, relative to the largest output
_POINTS = 3


def graph_network(graph: Graph) -> GraphNetwork:
    """The network of a graph. Raises ProblemError, which names operators that CasADi's reader does not know."""
    try:
        function = _read(_rewritten(graph))
    except RuntimeError as error:
        raise ProblemError(
            f"the graph is no chain of layers, and CasADi cannot read it: {_reason(error)}{_advice(graph)}"
        ) from None
    network = GraphNetwork(_columns(graph, function))
    _compare(graph, network)
    return network


def _read(model: Any) -> ca.Function:
    onnx: Any = import_module("onnx")
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "network.onnx"
        onnx.save(model, str(path))
        with contextlib.redirect_stderr(io.StringIO()):  # warnings of what the comparison would find
            return ca.GraphBuilder(str(path), {}).create("network", {"symbolic": True})


def _reason(error: RuntimeError) -> str:
    """The last line of CasADi's message, without the place in its sources."""
    return re.sub(r"^\S+\.[ch]pp:\d+: ", "", str(error).strip().splitlines()[-1]).rstrip(".")


def _advice(graph: Graph) -> str:
    """A sentence for graphs that can be stated in another way, or nothing."""
    if any(node.kind in ("GRU", "LSTM", "RNN") for node in graph.nodes):
        return (
            ". Write one step of it with nn.GRUCell, nn.LSTMCell or nn.RNNCell, whose state is an input and an output."
        )
    most = max(map(len, graph.shapes.values()))
    return "" if most < 3 else f". It has values of {most} axes: write it with values of the shape (1, n)."


def _columns(graph: Graph, function: ca.Function) -> ca.Function:
    """The same function of columns; the rows (1, n) of ONNX are transposed."""
    inputs = [ca.MX.sym(f"x{i}", graph.size(name)) for i, name in enumerate(graph.inputs)]
    rows = [ca.reshape(x, *function.size_in(i)) for i, x in enumerate(inputs)]
    return ca.Function("network", inputs, [ca.vec(ca.densify(function(*rows)))])


def _compare(graph: Graph, network: GraphNetwork) -> None:
    """Raise ProblemError unless the network has the numbers of the graph."""
    reference: Any = import_module("onnx.reference").ReferenceEvaluator(graph.model)
    kinds = {value.name: value.type.tensor_type.elem_type for value in graph.model.graph.input}
    to_numpy = import_module("onnx").helper.tensor_dtype_to_np_dtype
    rng = np.random.default_rng(0)
    for _ in range(_POINTS):
        given = {n: rng.normal(size=graph.shapes[n]).astype(to_numpy(kinds[n])) for n in graph.inputs}
        with np.errstate(all="ignore"):  # a logarithm of what is below zero is NaN in both
            expected = np.ravel(reference.run(None, given)[0])
        largest = np.abs(expected[np.isfinite(expected)]).max(initial=0.0)
        found = dense(network.function(*(np.ravel(x).astype(float) for x in given.values()))).ravel()
        if found.shape != expected.shape or not np.allclose(
            found, expected, rtol=0, atol=_AGREEMENT * (1 + largest), equal_nan=True
        ):
            raise ProblemError(
                "CasADi reads this graph with other numbers than ONNX's reference. "
                "Export the network for inputs of shape (1, n), and without operations across the first axis."
            )


def _rewritten(graph: Graph) -> Any:
    """A copy of the model with operators rewritten as ones that CasADi's reader knows."""
    onnx: Any = import_module("onnx")
    model = onnx.ModelProto()
    model.CopyFrom(graph.model)
    del model.graph.node[:], model.graph.value_info[:]
    writer = _Writer(graph, model)
    for original, node in zip(_operators(graph), graph.nodes, strict=True):
        rewrite = _REWRITES.get(node.kind)
        if rewrite is None:
            model.graph.node.append(original)
        else:
            rewrite(writer, node)
    return model


def _operators(graph: Graph) -> list[Any]:
    return [node for node in graph.model.graph.node if node.output[0] not in graph.constants]


class _Writer:
    """Appends nodes to a model."""

    def __init__(self, graph: Graph, model: Any) -> None:
        self.graph, self.model = graph, model
        self.onnx: Any = import_module("onnx")
        self.count = 0
        known = {tensor.name for tensor in model.graph.initializer}
        for name, value in graph.constants.items():
            if name not in known:
                model.graph.initializer.append(self.onnx.numpy_helper.from_array(value, name))

    def constant(self, value: Any) -> str:
        """The name of a new constant."""
        name = self._name()
        self.model.graph.initializer.append(self.onnx.numpy_helper.from_array(np.asarray(value), name))
        return name

    def put(self, kind: str, inputs: list[str], output: str = "", **attributes: Any) -> str:
        """The name of the result of a new node."""
        output = output or self._name()
        self.model.graph.node.append(self.onnx.helper.make_node(kind, inputs, [output], **attributes))
        return output

    def mean(self, x: str, n: int) -> str:
        """The mean of (1, n), as (1, 1)."""
        return self.put("Mul", [self.total("ReduceSum", x), self.constant(1.0 / n)])

    def total(self, kind: str, x: str) -> str:
        """Sum or maximum of (1, n), as (1, 1)."""
        return self.put(kind, [x, self.constant([-1])], keepdims=1)

    def _name(self) -> str:
        self.count += 1
        return f"rewritten_{self.count}"


def _batch_normalization(writer: _Writer, node: Node) -> None:
    constants = writer.graph.constants
    known = [np.asarray(constants[name], float) for name in node.inputs[1:] if name in constants]
    change = batch_normalisation(node, node.inputs[0], known)
    if change is None:
        raise ProblemError("BatchNormalization in training mode is no function of one point: export module.eval().")
    scaled = writer.put("Mul", [node.inputs[0], writer.constant(change[0])])
    writer.put("Add", [scaled, writer.constant(change[1])], node.outputs[0])


def _layer_normalization(writer: _Writer, node: Node) -> None:
    _check_last_axis(writer, node, node.attributes.get("axis", -1))
    n = writer.graph.size(node.inputs[0])
    centred = writer.put("Sub", [node.inputs[0], writer.mean(node.inputs[0], n)])
    _scale_to_unit(writer, node, centred, n)


def _rms_normalization(writer: _Writer, node: Node) -> None:
    _check_last_axis(writer, node, node.attributes.get("axis", -1))
    _scale_to_unit(writer, node, node.inputs[0], writer.graph.size(node.inputs[0]))


def _scale_to_unit(writer: _Writer, node: Node, x: str, n: int) -> None:
    """x / sqrt(mean(x^2) + epsilon) * scale + bias."""
    square = writer.put("Mul", [x, x])
    epsilon = writer.constant(float(node.attributes.get("epsilon", 1e-5)))
    deviation = writer.put("Sqrt", [writer.put("Add", [writer.mean(square, n), epsilon])])
    _, scale, *bias = node.inputs
    quotient = writer.put("Div", [x, deviation])
    scaled = writer.put("Mul", [quotient, scale], "" if bias else node.outputs[0])
    if bias:
        writer.put("Add", [scaled, *bias], node.outputs[0])


def _reduce_mean(writer: _Writer, node: Node) -> None:
    axes = node.attributes.get("axes") or writer.graph.constants.get((*node.inputs, "")[1], np.array([-1]))
    for axis in np.asarray(axes).ravel():
        _check_last_axis(writer, node, int(axis))
    mean = writer.mean(node.inputs[0], writer.graph.size(node.inputs[0]))
    if node.attributes.get("keepdims", 1):
        writer.put("Identity", [mean], node.outputs[0])
    else:
        writer.put("Reshape", [mean, writer.constant([1])], node.outputs[0])


def _softmax(writer: _Writer, node: Node) -> None:
    _check_last_axis(writer, node, node.attributes.get("axis", -1))
    shifted = writer.put("Sub", [node.inputs[0], writer.total("ReduceMax", node.inputs[0])])
    exponential = writer.put("Exp", [shifted])
    writer.put("Div", [exponential, writer.total("ReduceSum", exponential)], node.outputs[0])


def _check_last_axis(writer: _Writer, node: Node, axis: int) -> None:
    rank = len(writer.graph.shapes[node.inputs[0]])
    if axis % rank != rank - 1:
        raise ProblemError(f"{node.kind} along axis {axis} is not supported, only along the last one.")


def _squeeze(writer: _Writer, node: Node) -> None:
    shape = writer.graph.shapes.get(node.outputs[0])
    if shape is None:
        raise ProblemError(f"the shape of {node.outputs[0]!r} is not known.")
    writer.put("Reshape", [node.inputs[0], writer.constant(np.array(shape, np.int64))], node.outputs[0])


_REWRITES: dict[str, Callable[[_Writer, Node], None]] = {
    "BatchNormalization": _batch_normalization,
    "LayerNormalization": _layer_normalization,
    "RMSNormalization": _rms_normalization,
    "ReduceMean": _reduce_mean,
    "Softmax": _softmax,
    "Squeeze": _squeeze,
}
