"""A check of forward and adjoint passes that a problem supplies against those by CasADi's AD."""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.conditions.structure import same_numbers
from kpirl_ocp.ocp.problem.dynamics import DynamicsDerivatives
from kpirl_ocp.ocp.problem.guards import dense
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.trajectory_passes import TrajectoryPasses
from kpirl_ocp.types import Array

_STEPS = 2
_SIZE = 0.5  # of the random numbers: small enough that a network does not saturate


@lru_cache(maxsize=64)
def passes_agree(problem: OCP, columns: int) -> bool:
    """True if the passes that the problem supplies agree with AD along random trajectories (two steps, B columns).

    Analytic functions that agree at a random point agree everywhere, with probability one. Entries that are not finite
    must be so in both; their values are not compared.
    """
    if problem.derivatives is None:
        return True
    given, known = (
        _values(problem, derivatives.passes(_STEPS, columns), columns)
        for derivatives in (problem.derivatives, DynamicsDerivatives.by_ad(problem.transition))
    )
    return same_numbers(given, known)


def _values(problem: OCP, passes: TrajectoryPasses, columns: int) -> Array:
    """All outputs of the passes, at random inputs that are the same in every call."""
    n_s, n_u, n_psi = (problem.transition.size1_in(i) for i in range(3))
    sizes = (n_s, 1), (n_psi, 1), (n_u, _STEPS), (n_u, _STEPS), (n_s, _STEPS + 1), (n_s, _STEPS + 1)
    symbols = [ca.MX.sym("x", rows, steps * columns) for rows, steps in sizes]
    s0, psi, actions, moves, slopes, changes = symbols
    at = passes.rollout(s0, actions, psi)
    moved, adjoint = passes.tangent(at, psi, moves), passes.adjoint(at, psi, slopes)
    change = passes.adjoint_tangent(at, psi, adjoint.memory, moved, moves, changes)
    found = [at.states, moved.states, *adjoint[:3], *change[:3]]
    rng = np.random.default_rng(0)
    numbers = [_SIZE * rng.normal(size=symbol.shape) for symbol in symbols]
    values = ca.Function("passes", symbols, [ca.densify(ca.veccat(*found))])(*numbers)
    return dense(values).ravel()
