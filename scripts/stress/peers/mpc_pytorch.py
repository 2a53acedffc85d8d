"""mpc.pytorch on linear dynamics, quadratic costs, and bounds of the actions."""

import casadi as ca
import numpy as np
import torch
from mpc.mpc import MPC, GradMethods, LinDx, QuadCost

from stress.peers.program import CannotState, Program, Refused
from stress.peers.quadratic_form import quadratic_form


def _parts(program: Program):
    """C_t, c_t, F_t, f_t as functions of p; and whether they depend on state or action."""
    problem = program.case.problem
    n, m = program.n_states, program.n_actions
    if problem.path_constraint or problem.path_equality or problem.n_terminal or problem.terminal_equality:
        raise CannotState("constraints other than bounds on actions")
    if any(np.isfinite(bound[1:]).any() for bound in problem.state_bounds):
        raise CannotState("bounds of states")
    tau, p = ca.SX.sym("tau", n + m), program.p
    stages = np.asarray(problem.schedule)
    parts = []
    for t in range(program.steps + 1):
        last = t == program.steps
        cost = (
            problem.terminal_cost(tau[:n], p, [], stages[t]) + ca.sumsqr(tau[n:])
            if last
            else problem.stage_cost(tau[:n], tau[n:], p, [], stages[t])
        )
        after = ca.SX.zeros(n) if last else problem.dynamics(tau[:n], tau[n:], p, [], stages[t])
        hessian, slope = ca.hessian(cost, tau)
        matrix = ca.jacobian(after, tau)
        if any(ca.depends_on(ca.simplify(e), tau) for e in (hessian, matrix)):
            raise CannotState("not linear-quadratic")
        zero = ca.DM.zeros(n + m)
        parts.append(
            [ca.densify(e) for e in (hessian, ca.substitute(slope, tau, zero), matrix, ca.substitute(after, tau, zero))]
        )
    return parts


def gradient(program: Program):
    """dL/dp and the plan."""
    quadratic_form(program)  # not bent
    parts, psi, steps = _parts(program), program.case.psi, program.steps
    n, m = program.n_states, program.n_actions
    stacked = [ca.horzcat(*(ca.vec(part[k].T) for part in parts[: steps + 1 - (k > 1)])) for k in range(4)]
    functions = [ca.Function("part", [program.p], [e]) for e in stacked]
    shapes = [(steps + 1, 1, n + m, n + m), (steps + 1, 1, n + m), (steps, 1, n, n + m), (steps, 1, n)]
    numbers = [
        torch.tensor(np.array(f(psi)).T.reshape(shape), requires_grad=True)
        for f, shape in zip(functions, shapes, strict=True)
    ]
    limits = [
        np.vstack([b, s * np.ones((1, m))])[:, None]
        for b, s in zip(program.case.problem.action_bounds, (-1, 1), strict=True)
    ]
    bounds = {}
    if np.isfinite(np.concatenate(limits)).any():
        bounds = {
            name: torch.tensor(np.clip(b, -1e6, 1e6)) for name, b in zip(("u_lower", "u_upper"), limits, strict=True)
        }
    solver = MPC(
        n,
        m,
        steps + 1,
        **bounds,
        lqr_iter=200,
        verbose=-1,
        n_batch=1,
        eps=1e-10,
        back_eps=1e-10,
        grad_method=GradMethods.ANALYTIC,
    )
    try:
        states, actions, _ = solver(torch.tensor(program.s0)[None], QuadCost(*numbers[:2]), LinDx(*numbers[2:]))
    except Exception as error:
        raise Refused(str(error)) from error
    S, U = states[:, 0].detach().numpy(), actions[:-1, 0].detach().numpy()
    x = np.concatenate([S[1:].ravel(), U.ravel()])
    slope = np.array(
        ca.Function("slope", [program.x, program.p], [ca.gradient(program.loss, program.x)])(x, psi)
    ).ravel()
    if not (states.requires_grad or actions.requires_grad):
        raise Refused("detached: not converged")
    weights = torch.tensor(slope[: n * steps].reshape(steps, n)), torch.tensor(slope[n * steps :].reshape(steps, m))
    (torch.sum(states[1:, 0] * weights[0]) + torch.sum(actions[:-1, 0] * weights[1])).backward()
    total = np.zeros(len(psi))
    for number, expression in zip(numbers, stacked, strict=True):
        if number.grad is not None:
            jacobian = ca.Function("jacobian", [program.p], [ca.densify(ca.jacobian(ca.vec(expression), program.p))])(
                psi
            )
            total += number.grad.numpy().reshape(len(number), -1).ravel() @ np.array(jacobian)
    return total, program.plan(x)
