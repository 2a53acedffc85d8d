"""A torch module as a network in the CasADi graph, through torch's own ONNX exporter (extra `torch`)."""

from __future__ import annotations

import copy
import logging
import tempfile
import warnings
from pathlib import Path

import torch

from kpirl_ocp.errors import ModelError
from kpirl_ocp.ocp.models.graph_network import GraphNetwork
from kpirl_ocp.ocp.models.mlp import MLP
from kpirl_ocp.ocp.models.onnx.load import load_onnx


def from_torch(module: torch.nn.Module, *sizes: int) -> MLP | GraphNetwork:
    """The network of a module whose forward takes tensors (1, n_1), (1, n_2), ... and returns one tensor (1, n_out).

    The module is left as it is; a copy in evaluation mode and float64 is exported.

    Args:
        module: any module that `torch.onnx.export` can export.
        sizes: n_1, n_2, ..., the lengths of its inputs.

    Returns:
        An `MLP`, with derivatives arranged by hand, where the module is a chain of layers; else a `GraphNetwork`.

    Raises:
        ModelError: torch cannot export the module, or `load_onnx` cannot read the result; the message says why.
    """
    exported = copy.deepcopy(module).cpu().double().eval()
    inputs = tuple(torch.zeros(1, size, dtype=torch.float64) for size in sizes)
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / f"{type(module).__name__}.onnx"
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of the exporter, about its own parts
                logging.getLogger("torch.onnx").setLevel(logging.ERROR)
                torch.onnx.export(exported, inputs, str(path), dynamo=True, verbose=False)
        except Exception as error:  # of the module or of any stage of the exporter
            raise ModelError(
                f"torch cannot export {type(module).__name__} for inputs of the lengths {sizes}: {error}"
            ) from error
        return load_onnx(path)
