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
from kpirl_ocp.irl.hypergradients.certificate import Hypergradient, enforce
from kpirl_ocp.irl.hypergradients.implicit import Implicit, differentiate
from kpirl_ocp.irl.hypergradients.loss import squared_distance
from kpirl_ocp.irl.hypergradients.unrolled import Unrolled, gradient_alone
from kpirl_ocp.ocp.problem.guards import dense
from kpirl_ocp.ocp.problem.layout import split
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import solve_and_linearise
from kpirl_ocp.ocp.sensitivity.certificate import Certificate, require
from kpirl_ocp.ocp.sensitivity.implicit_function import ByParameters, ImplicitFunction
from kpirl_ocp.types import Array, Demonstration, Solution, Trajectory

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
    numbers = demonstration.s0, psi, demonstration.context
    solution, derivatives = solve_and_linearise(method.inner, problem, *numbers)
    if not np.isfinite(observed(problem, solution.states)).all():
        return _none(problem, solution, method.policy)
    combined = _Planned(problem, demonstration, solution).combined()
    result = enforce(method.policy, differentiate(problem, combined, solution, derivatives=derivatives))
    function, fixed = ImplicitFunction.at(problem, solution), (np.zeros(problem.n_states), np.zeros(problem.n_context))
    pushed = [function.push(ByParameters(direction, *fixed))[0].x for direction in np.eye(problem.n_parameters)]
    changes = [split(x, problem.horizon, problem.n_states, problem.n_actions)[0] for x in pushed]
    slopes = observation_jacobians(problem, solution.states)  # (T, n_z, n_s)
    columns = [np.einsum("tzs,ts->tz", slopes, change[1:]).ravel() for change in changes]
    jacobian = np.reshape(columns, (problem.n_parameters, -1)).T
    return PlanJacobian(solution.trajectory, observed(problem, solution.states), jacobian, result.certificate.certified)


def _unrolled(problem: OCP, demonstration: Demonstration, psi: ArrayLike, method: Unrolled) -> PlanJacobian:
    plan = method.solver.solve(problem, demonstration.s0, psi, demonstration.context)
    if not np.isfinite(observed(problem, plan.states)).all():
        return _none(problem, plan, method.policy)
    planned, unrolled = _Planned(problem, demonstration, plan), replace(method, loss=squared_distance)
    certificate = unrolled(problem, planned.combined(), psi).certificate
    rows = [
        gradient_alone(unrolled, problem, planned.shifted(row), psi) for row in np.eye(planned.observations[1:].size)
    ]
    jacobian = np.reshape(rows, (-1, problem.n_parameters))
    return PlanJacobian(plan.trajectory, observed(problem, plan.states), jacobian, certificate.certified)


def _none(problem: OCP, plan: Solution, policy: str) -> PlanJacobian:
    """NaN, flagged; CertificateError under another policy."""
    failure = "The plan or its observations are NaN or infinite: look at the solution's status and the dynamics."
    require(policy, Certificate(solution=plan, failures=(failure,)), "the plan's derivative")
    seen = observed(problem, plan.states)
    return PlanJacobian(plan.trajectory, seen, np.full((len(seen), problem.n_parameters), np.nan), certified=False)


class _Planned:
    """Demonstrations next to a plan, such that the gradients of their losses are rows of dz/dpsi.

    observations: (T+1, n_z) of the plan, which are finite.
    """

    def __init__(self, problem: OCP, demonstration: Demonstration, plan: Solution) -> None:
        self._start = demonstration
        self.observations = dense(problem.observe(plan.states.T)).T

    def shifted(self, direction: Array) -> Demonstration:
        """The plan minus half of direction (T n_z,): its loss |z - z_demo|^2 has the gradient (dz/dpsi)^T direction."""
        observations = self.observations.copy()
        observations[1:] -= 0.5 * direction.reshape(observations[1:].shape)
        return Demonstration(self._start.s0, self._start.context, observations)

    def combined(self) -> Demonstration:
        """Shifted in a random direction, so that its loss has a kink wherever a row of dz/dpsi has one."""
        return self.shifted(np.random.default_rng(0).normal(size=self.observations[1:].size))


def observed(problem: OCP, states: Array) -> Array:
    """z_1 .. z_T (T n_z,) of states (T+1, n_s)."""
    return dense(problem.observe(states.T)).T[1:].ravel()


def observation_jacobians(problem: OCP, states: Array) -> Array:
    """dz_t/ds_t (T, n_z, n_s), t = 1 .. T."""
    slopes = dense(_observation_slope(problem).map(problem.horizon)(states[1:].T))
    return slopes.T.reshape(problem.horizon, problem.n_states, problem.n_observations).transpose(0, 2, 1)


@lru_cache(maxsize=64)
def _observation_slope(problem: OCP) -> ca.Function:
    """s -> dz/ds (n_z, n_s)."""
    state = ca.MX.sym("s", problem.n_states)
    seen = state if problem.observation is None else problem.observation(state)
    return ca.Function("slope", [state], [ca.densify(ca.jacobian(seen, state))])
