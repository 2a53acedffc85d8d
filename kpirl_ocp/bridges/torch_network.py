"""A torch module as a network in the CasADi graph, through torch's own ONNX exporter (extra `torch`)."""

from __future__ import annotations

import contextlib
import copy
import io
import logging
import re
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path

import torch

from kpirl_ocp.errors import DependencyError, ModelError, ProblemError
from kpirl_ocp.ocp.models.graph_network import GraphNetwork
from kpirl_ocp.ocp.models.mlp import MLP
from kpirl_ocp.ocp.models.onnx.load import read_network


def from_torch(module: torch.nn.Module, *sizes: int) -> MLP | GraphNetwork:
    """The network of a module whose forward takes tensors (1, n_1), (1, n_2), ... and returns one tensor (1, n_out).

    The module is left as it is; a copy in evaluation mode and float64 is run once on zeros, and exported.

    Args:
        module: any module that `torch.onnx.export` can export.
        sizes: n_1, n_2, ..., the lengths of its inputs.

    Returns:
        An `MLP`, with derivatives arranged by hand, where the module is a chain of layers; else a `GraphNetwork`.

    Raises:
        DependencyError: onnx or onnxscript, which torch's exporter needs, is not installed.
        ModelError: it is no module, it does not run on inputs of these lengths, torch cannot export it, or the result
            cannot be read as a network; the message says why.
    """
    if not isinstance(module, torch.nn.Module):
        raise ModelError(f"from_torch needs a torch.nn.Module with its weights, got {_kind(module)}.")
    name, inputs = type(module).__name__, _zeros(sizes)
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "network.onnx"
        with _silence():
            _export(_running(module, inputs), inputs, path)
        try:
            return read_network(path)
        except ProblemError as error:
            raise ModelError(f"{name}: {error}") from error


def _kind(value: object) -> str:
    return f"the class {value.__name__}" if isinstance(value, type) else type(value).__name__


def _zeros(sizes: tuple[object, ...]) -> tuple[torch.Tensor, ...]:
    lengths = [size for size in sizes if isinstance(size, int) and not isinstance(size, bool) and size > 0]
    if not lengths or len(lengths) < len(sizes):
        raise ModelError(
            "from_torch needs the length of every input of forward, whole numbers of at least 1, as in "
            f"from_torch(module, 2, 1) for a state of 2 and an action of 1; got {sizes}."
        )
    return tuple(torch.zeros(1, length, dtype=torch.float64) for length in lengths)


def _running(module: torch.nn.Module, inputs: tuple[torch.Tensor, ...]) -> torch.nn.Module:
    """A copy for export, of which one call with these inputs returns a tensor."""
    name, shapes = type(module).__name__, ", ".join(str(tuple(x.shape)) for x in inputs)
    try:
        copied = copy.deepcopy(module).cpu().double().eval()
        with torch.no_grad():
            returned = copied(*inputs)
    except Exception as error:  # of the module
        raise ModelError(
            f"{name} does not run on float64 zeros of {shapes}: {_in_one_line(error)} "
            "from_torch needs the length of every input of its forward."
        ) from error
    if not isinstance(returned, torch.Tensor):
        raise ModelError(
            f"the forward of {name} must return one tensor (1, n_out), got {type(returned).__name__}: "
            "wrap it in a module that returns the tensor you need, or several by torch.cat."
        )
    return copied


def _export(module: torch.nn.Module, inputs: tuple[torch.Tensor, ...], path: Path) -> None:
    try:
        torch.onnx.export(module, inputs, str(path), dynamo=True, verbose=False)
    except ImportError as error:
        raise DependencyError('from_torch needs onnx and onnxscript: pip install "kpirl-ocp[torch]".') from error
    except Exception as error:  # of any stage of the exporter
        cause = error.__cause__ or error  # the exporter's own words are pages of advice about the exporter
        raise ModelError(
            f"torch runs {type(module).__name__}, but cannot export it: {_in_one_line(cause)} "
            "Its forward must be tensor operations that do not branch on values (torch.where instead of if)."
        ) from error


def _in_one_line(error: BaseException) -> str:
    """The kind of an error and the first sentence of what it says."""
    said = " ".join(re.split(r"\n\s*\n", str(error).strip())[0].split())
    return f"{type(error).__name__}: {said.rstrip('.')}."


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """A block in which neither warnings nor the logs of torch's exporter, about its own parts, are shown."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        unread = io.StringIO()
        with warnings.catch_warnings(), contextlib.redirect_stdout(unread), contextlib.redirect_stderr(unread):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)
