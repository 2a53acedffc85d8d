"""The derivative of planned observations with respect to psi, dz_t/dpsi, along one demonstration.

Of the converged problem it comes from the implicit function theorem, column by column. Of N gradient steps it comes
from the gradient of the IRL loss, row by row: L = |z - z_demo|^2 has dL/dpsi = 2 (dz/dpsi)^T (z - z_demo), which is
row k of dz/dpsi for z_demo = z - e_k / 2.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.hypergradients.certificate import Hypergradient
from kpirl_ocp.irl.hypergradients.implicit import Implicit
from kpirl_ocp.irl.hypergradients.unrolled import Unrolled, gradient_alone
from kpirl_ocp.ocp.problem.layout import split
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.sensitivity.implicit_function import ByParameters, ImplicitFunction
from kpirl_ocp.types import Array, Demonstration, Trajectory

CONVERGED = Implicit()  # how the plan depends on psi, unless said otherwise


class PlanJacobian(NamedTuple):
    """One plan and its derivative by psi.

    trajectory: the plan. observations: z_1 .. z_T (T n_z,). jacobian: (T n_z, n_psi); z_0 does not depend on psi.
    certified: False if the hypergradient's policy is "flag" and it had something to flag.
    """

    trajectory: Trajectory
    observations: Array
    jacobian: Array
    certified: bool


def plan_jacobian(problem: OCP, demonstration: Demonstration, psi: ArrayLike, method: Hypergradient) -> PlanJacobian:
    """Plan from the start of a demonstration with psi (n_psi,), and differentiate the observations.

    Args:
        problem: to plan with.
        demonstration: of which s0 and context count.
        psi: (n_psi,).
        method: `Implicit` for the converged problem, `Unrolled` for gradient steps; its loss does not matter.

    Raises:
        CertificateError: under the policy "raise", when the plan has no certified derivative.
        ProblemError: another method, or shapes that do not fit.
    """
    if isinstance(method, Implicit):
        return _converged(problem, demonstration, psi, method)
    if isinstance(method, Unrolled):
        return _unrolled(problem, demonstration, psi, method)
    raise ProblemError(f"the plan's derivative needs Implicit(...) or Unrolled(...), not {type(method).__name__}.")


def _converged(problem: OCP, demonstration: Demonstration, psi: ArrayLike, method: Implicit) -> PlanJacobian:
    certificate = method(problem, demonstration, psi).certificate
    solution = certificate.solution
    function, fixed = ImplicitFunction.at(problem, solution), (np.zeros(problem.n_states), np.zeros(problem.n_context))
    pushed = [function.push(ByParameters(direction, *fixed))[0].x for direction in np.eye(problem.n_parameters)]
    changes = [split(x, problem.horizon, problem.n_states, problem.n_actions)[0] for x in pushed]
    slopes = observation_jacobians(problem, solution.states)  # (T, n_z, n_s)
    columns = [np.einsum("tzs,ts->tz", slopes, change[1:]).ravel() for change in changes]
    jacobian = np.reshape(columns, (problem.n_parameters, -1)).T
    return PlanJacobian(solution.trajectory, observed(problem, solution.states), jacobian, certificate.certified)


def _unrolled(problem: OCP, demonstration: Demonstration, psi: ArrayLike, method: Unrolled) -> PlanJacobian:
    plan = method.solver.solve(problem, demonstration.s0, psi, demonstration.context)
    planned = problem.observe(plan.states.T).full().T  # (T+1, n_z)
    finite = planned if np.isfinite(planned).all() else np.zeros(planned.shape)  # the certificate says which
    unrolled, shape = Unrolled(method.solver, policy=method.policy, checkpoint=method.checkpoint), planned[1:].shape

    def beside(direction: Array) -> Demonstration:
        """Of which the loss has the gradient (dz/dpsi)^T direction (T n_z,)."""
        shift = np.vstack([np.zeros(shape[1]), direction.reshape(shape)])
        return replace(demonstration, observations=finite - 0.5 * shift, actions=None, frames=None)

    # A kink of any row is one of a random combination of all; a loss that vanishes at the plan would hide it.
    combined = beside(np.random.default_rng(0).normal(size=shape))
    certificate = unrolled(problem, combined, psi).certificate
    rows = [gradient_alone(unrolled, problem, beside(row), psi) for row in np.eye(finite[1:].size)]
    jacobian = np.reshape(rows, (-1, problem.n_parameters))
    return PlanJacobian(plan.trajectory, planned[1:].ravel(), jacobian, certificate.certified)


def observed(problem: OCP, states: Array) -> Array:
    """z_1 .. z_T (T n_z,) of states (T+1, n_s)."""
    return problem.observe(states.T).full().T[1:].ravel()


def observation_jacobians(problem: OCP, states: Array) -> Array:
    """dz_t/ds_t (T, n_z, n_s), t = 1 .. T."""
    slopes = _observation_slope(problem).map(problem.horizon)(states[1:].T).full()
    return slopes.T.reshape(problem.horizon, problem.n_states, problem.n_observations).transpose(0, 2, 1)


@lru_cache(maxsize=64)
def _observation_slope(problem: OCP) -> ca.Function:
    """s -> dz/ds (n_z, n_s)."""
    state = ca.MX.sym("s", problem.n_states)
    seen = state if problem.observation is None else problem.observation(state)
    return ca.Function("slope", [state], [ca.densify(ca.jacobian(seen, state))])
