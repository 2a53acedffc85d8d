"""Gradient descent as C: the functions of one step, forwards and backwards; the loop and the projection are C.

With g(U; p) = dJ/dU, p = (psi, c, s_0), a step U' = P(U - alpha g) takes an adjoint v back as

    w = P' v,    v <- w - alpha (dg/dU)' w,    dL/dp <- dL/dp - alpha (dg/dp)' w
"""

from __future__ import annotations

import casadi as ca

from kpirl_ocp.ocp.codegen.target import Target, dynamics, named
from kpirl_ocp.ocp.problem.linearised_dynamics import LinearisedDynamics, depends_on_psi
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.reduced_cost import Linearisation, ReducedCost, reduced_symbols
from kpirl_ocp.ocp.problem.trajectory_cost import Coefficients
from kpirl_ocp.ocp.problem.trajectory_passes import Adjoint
from kpirl_ocp.ocp.solvers.gradient_descent import GradientDescent, check_constraints


def target(problem: OCP, solver: GradientDescent) -> Target:
    """Cost and gradient at a point, a Hessian product with its shares for psi, c and s_0, and the slope of a loss."""
    check_constraints(problem, solver.project)
    return Target(
        kind="gradient_descent",
        functions=[dynamics(problem), descent_point(problem), descent_back(problem), descent_slope(problem)],
        interfaces={"dynamics": "stage"},
        transition="dynamics",
        sources=("descent.h", "descent.c"),
        workspace="descent.h",
        macros={"STEP_SIZE": repr(solver.step_size)},
        steps=solver.steps,
        max_iterations=solver.steps,
        tolerance=solver.tolerance,
        barrier=0.0,
        single_tolerance=1e-3,
    )


def descent_point(problem: OCP) -> ca.Function:
    """(U, s0, psi, c) -> J, dJ/dU, states, costates."""
    inputs, _, _, at = _linearise(problem)
    outputs = {"cost": at.value, "gradient": at.gradient, "states": at.rollout.states, "costates": at.adjoint.costates}
    return named("descent_point", _names(inputs), outputs)


def descent_back(problem: OCP) -> ca.Function:
    """(U, s0, psi, c, w (n_u, T)) -> (dg/dU)' w for g = dJ/dU, and w . g by psi, c and s0."""
    inputs, reduced, theta, at = _linearise(problem)
    u, _, psi, context = inputs
    w = ca.MX.sym("w", *u.shape)
    dS = reduced.passes.tangent(at.rollout, psi, w)
    by_states, by_actions, by_theta = reduced.cost.second(at.rollout.states, u, theta, dS.states, w)
    back = reduced.passes.adjoint_tangent(at.rollout, psi, at.adjoint.memory, dS, w, by_states)
    x = [ca.MX.sym("x", *share.shape) for share in by_theta]
    paired = ca.dot(theta.stages, x[0]) + ca.dot(theta.last, x[1])
    pull = ca.Function("pull", [psi, context, *x], [ca.gradient(paired, p) for p in (psi, context)])
    by_psi, by_context = pull(psi, context, *by_theta)
    by_start = _by_start(problem, at, back, by_states, w, psi)
    outputs = {"product": by_actions + back.by_actions, "by_psi": by_psi + back.by_parameters}
    outputs |= {"by_context": by_context, "by_state": by_start}
    return named("descent_back", _names(inputs) | {"direction": w}, outputs)


def descent_slope(problem: OCP) -> ca.Function:
    """(U, s0, psi, c, L_S (n_s, T+1), L_U (n_u, T)) -> dL/dU, and L by psi and s0 at fixed U."""
    inputs, reduced, _, at = _linearise(problem)
    by_states = ca.MX.sym("L_S", problem.n_states, problem.horizon + 1)
    by_actions = ca.MX.sym("L_U", problem.n_actions, problem.horizon)
    adjoint = reduced.passes.adjoint(at.rollout, inputs[2], by_states)
    start = _dynamics_at_start(problem, at, inputs[2], adjoint.costates)
    by_start = by_states[:, 0] + start.Ft_lambda[: problem.n_states]
    outputs = {"slope": by_actions + adjoint.by_actions, "by_psi": adjoint.by_parameters, "by_state": by_start}
    return named("descent_slope", _names(inputs) | {"by_states": by_states, "by_actions": by_actions}, outputs)


def _names(inputs: list[ca.MX]) -> dict[str, ca.MX]:
    return dict(zip(("actions", "state", "psi", "context"), inputs, strict=True))


def _linearise(problem: OCP) -> tuple[list[ca.MX], ReducedCost, Coefficients, Linearisation]:
    """Symbols U, s0, psi and c, the reduced cost, its coefficients theta, and its linearisation there."""
    inputs, reduced = list(reduced_symbols(problem)), ReducedCost(problem)
    u, s0, psi, context = inputs
    theta = reduced.cost.coefficients(psi, context)
    return inputs, reduced, theta, reduced.linearise(s0, u, psi, theta)


def _by_start(problem: OCP, at: Linearisation, back: Adjoint, by_states: ca.MX, w: ca.MX, psi: ca.MX) -> ca.MX:
    """d(w . dJ/dU)/ds_0 = l_su w_0 + f_s' dlambda_1 + (lambda_1 . f)_su w_0, the tangent of lambda_0 along w."""
    start, n_s = _dynamics_at_start(problem, at, psi, at.adjoint.costates), problem.n_states
    change = start.Ft_lambda_tangent(ca.vertcat(ca.MX.zeros(n_s), w[:, 0]), back.costates[:, 0])
    return by_states[:, 0] + change[:n_s]


def _dynamics_at_start(problem: OCP, at: Linearisation, psi: ca.MX, costates: ca.MX) -> LinearisedDynamics:
    """f at (s_0, u_0) with lambda_1, the first column of the costates."""
    given = psi if depends_on_psi(problem.dynamics) else ca.MX(0, 1)
    stage = at.rollout.states[:, 0], at.rollout.actions[:, 0], given, costates[:, 0]
    return problem.dynamics_derivatives.linearise(*stage)
