"""Networks from ONNX files, read with the `onnx` package (an optional dependency).

A chain of layers becomes an `MLP`, with derivatives arranged by hand; any other graph becomes a `GraphNetwork`.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

from kpirl_ocp.errors import DependencyError, ModelError, ProblemError
from kpirl_ocp.ocp.models.graph_network import GraphNetwork
from kpirl_ocp.ocp.models.mlp import MLP
from kpirl_ocp.ocp.models.onnx.casadi_reader import graph_network
from kpirl_ocp.ocp.models.onnx.chain import chain
from kpirl_ocp.ocp.models.onnx.graph import Graph
from kpirl_ocp.sizes import check_file


def load_onnx(path: str | Path) -> MLP | GraphNetwork:
    """The network of an ONNX graph: inputs (1, n_i) or (n_i,), of which the first axis may be dynamic, and one output.

    Numbers are computed in float64 from the weights in the file.

    Raises:
        DependencyError: `onnx` is not installed.
        ModelError: the file cannot be read, or the graph holds an operator that neither this package nor CasADi's
            reader knows; it names the operator.
    """
    try:
        return read_network(Path(path))
    except ProblemError as error:
        raise ModelError(f"{path}: {error}") from error


def read_network(path: Path) -> MLP | GraphNetwork:
    """The same; what is wrong with the graph is a ProblemError that does not name the file."""
    try:
        onnx: Any = import_module("onnx")
    except ImportError as error:
        raise DependencyError("reading ONNX files needs the package onnx: pip install onnx.") from error
    try:
        check_file(path)
        model = onnx.load(str(path))
    except Exception as error:  # of onnx, protobuf or the file system
        raise ModelError(f"{path} cannot be read as ONNX: {error}") from error
    graph = Graph.of_model(model)
    return chain(graph) or graph_network(graph)
