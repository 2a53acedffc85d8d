"""Who can take part: this package, and the peers that are installed."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from functools import partial

import numpy as np

from kpirl_ocp import GradientDescent, Unrolled
from kpirl_ocp.irl.cases.network_cases import N_Q, NetworkCase
from kpirl_ocp.irl.hypergradients.loss import squared_distance
from kpirl_ocp.irl.hypergradients.unrolled_graph import unrolled_function
from kpirl_ocp.ocp.codegen.compiler import compiled
from kpirl_ocp.ocp.codegen.numpy_calls import Call
from kpirl_ocp.types import Array

Evaluation = Callable[[], tuple[float, Array]]
"""Loss and gradient (T, n_z); several demonstrations give the means."""
Prepare = Callable[[NetworkCase], Evaluation]

OURS = "ours"
ALONE = "ours, compiled function alone"
NOT_INSTALLED = "not installed: pip install .[bench]"
# name: module of the peer, what it needs, and its options
_PEERS = {
    "torch, create_graph": ("peer_torch", "torch", {}),
    "plain CasADi": ("peer_casadi", "casadi", {}),
    "JAX jit, scan": ("peer_jax", "jax", {}),
    "JAX jit, scan unrolled by 5": ("peer_jax", "jax", {"unroll": 5}),
}
JAX = tuple(name for name in _PEERS if name.startswith("JAX"))
TORCH, PLAIN = "torch, create_graph", "plain CasADi"
NAMES = (*_PEERS, OURS)


def find(name: str) -> Prepare | None:
    """The function that prepares a contender for data; None if it is not installed. Imports it."""
    if name in (OURS, ALONE):
        return ours if name == OURS else alone
    module, needed, options = _PEERS[name]
    if importlib.util.find_spec(needed) is None:
        return None
    return partial(importlib.import_module(f"bench.{module}").unrolled, **options)


def ours(data: NetworkCase) -> Evaluation:
    """The public call, with its certificate and audited solution."""
    method = Unrolled(GradientDescent(data.steps, data.step_size), policy="flag")  # ReLU has kinks
    psi = data.psi.ravel()

    def evaluate() -> tuple[float, Array]:
        results = method.batch(data.problem, data.demonstrations, psi)
        loss, gradient = (sum(x[i] for x in results) / len(results) for i in (0, 1))
        return loss, gradient.reshape(data.psi.shape)

    return evaluate


def alone(data: NetworkCase) -> Evaluation:
    """The compiled function of one demonstration, without checks, audit and certificate around it."""
    solver, psi = GradientDescent(data.steps, data.step_size), data.psi.ravel()
    function = Call(compiled(unrolled_function(data.problem, solver, squared_distance, data.steps, False, 1)))
    actions = np.zeros((data.horizon, N_Q))

    def evaluate() -> tuple[float, Array]:
        (output,) = function(actions, data.s0[0], psi, data.goal[0], data.observed[0])
        return float(output[0]), output[5 : 5 + psi.size].reshape(data.psi.shape)

    return evaluate
