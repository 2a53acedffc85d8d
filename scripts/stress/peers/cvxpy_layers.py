"""cvxpylayers on quadratic programs; psi enters through its linear terms, which are parameters."""

import casadi as ca
import cvxpy as cp
import numpy as np
import torch
from cvxpylayers.torch import CvxpyLayer

from stress.peers.program import Program, Refused
from stress.peers.quadratic_form import quadratic_form

ARGUMENTS = {"solve_method": "Clarabel", "tol_gap_abs": 1e-10, "tol_gap_rel": 1e-10, "tol_feas": 1e-10}


def gradient(program: Program):
    """dL/dp and the plan."""
    form, psi = quadratic_form(program), program.case.psi
    x, c, b = (cp.Variable(program.x.numel()), cp.Parameter(program.x.numel()), cp.Parameter(program.g.numel()))
    equal = program.lbg == program.ubg
    rows = [form.A[equal] @ x + b[equal] == 0]
    rows += [form.A[~equal] @ x + b[~equal] <= 0] if (~equal).any() else []
    for bound, sign in ((program.lbx, -1), (program.ubx, 1)):
        at = np.isfinite(bound)
        rows += [sign * x[at] <= sign * bound[at]] if at.any() else []
    root = np.linalg.cholesky(form.H + 1e-300 * np.eye(len(form.H))) if _definite(form.H) else _root(form.H)
    objective = cp.Minimize(cp.sum_squares(root.T @ x) / 2 + c @ x)
    layer = CvxpyLayer(cp.Problem(objective, rows), parameters=[c, b], variables=[x], solver_args=ARGUMENTS)
    numbers = [torch.tensor(np.array(f(psi)).ravel(), requires_grad=True) for f in (form.c, form.b)]
    try:
        (found,) = layer(*numbers)
    except Exception as error:
        raise Refused(str(error)) from error
    at = found.detach().numpy().astype(float)
    slope = ca.Function("slope", [program.x, program.p], [ca.gradient(program.loss, program.x)])(at, psi)
    found.backward(torch.tensor(np.array(slope).ravel()))
    total = np.zeros(len(psi))
    for number, function in zip(numbers, (form.c, form.b), strict=True):
        total += number.grad.numpy() @ _jacobian(function, psi)
    return total, program.plan(at)


def _definite(matrix):
    return np.linalg.eigvalsh(matrix).min() > 1e-12 * np.abs(matrix).max()


def _root(matrix):
    values, vectors = np.linalg.eigh(matrix)
    return vectors * np.sqrt(np.maximum(values, 0))


def _jacobian(function, psi):
    p = ca.SX.sym("p", len(psi))
    return np.array(ca.Function("jacobian", [p], [ca.densify(ca.jacobian(function(p), p))])(psi))
