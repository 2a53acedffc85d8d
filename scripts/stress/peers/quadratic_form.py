"""A program as a quadratic one, x' H x / 2 + (c + C p)' x  subject to linear rows; refused if it is none."""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np

from stress.peers.program import CannotState, Program


class QuadraticForm(NamedTuple):
    """H (n, n), c(p), rows A x and their offsets b(p), as functions of p; so that c and b may bend in p."""

    H: np.ndarray
    A: np.ndarray
    c: ca.Function
    b: ca.Function


def quadratic_form(program: Program) -> QuadraticForm:
    """Raises CannotState when Hessian or rows depend on x or p, as convex programs with parameters must not."""
    x, p = program.x, program.p
    hessian, slope = ca.hessian(program.f, x)
    rows = ca.jacobian(program.g, x)
    for matrix in (hessian, rows):
        if ca.depends_on(ca.simplify(matrix), ca.vertcat(x, p)):
            raise CannotState("not a quadratic program")
    H, A = (np.array(ca.evalf(ca.densify(matrix))) for matrix in (hessian, rows))
    if not np.isfinite(H).all() or np.linalg.eigvalsh(H).min() < -1e-9 * np.abs(H).max():
        raise CannotState("not convex")
    at_zero = [ca.substitute(e, x, ca.DM.zeros(x.numel())) for e in (slope, program.g)]
    c, b = (ca.Function(name, [p], [ca.densify(e)]) for name, e in zip("cb", at_zero, strict=True))
    _check(program, QuadraticForm(H, A, c, b), slope)
    return QuadraticForm(H, A, c, b)


def _check(program: Program, form: QuadraticForm, slope) -> None:
    """Second derivatives do not see kinks and jumps: compare the first ones at random points."""
    values = ca.Function("values", [program.x, program.p], [slope, program.g, program.f])
    rng, psi = np.random.default_rng(0), program.case.psi
    size = max(1.0, np.abs(program.start).max())
    c, b = (np.array(function(psi)).ravel() for function in (form.c, form.b))
    at_zero = float(values(np.zeros(program.x.numel()), psi)[2])
    for x in size * rng.normal(size=(8, program.x.numel())):
        found, rows, cost = (np.array(value).ravel() for value in values(x, psi))
        expected = form.H @ x + c, form.A @ x + b, at_zero + form.H @ x @ x / 2 + c @ x
        for one, other in zip((found, rows, cost), expected, strict=True):
            if not np.allclose(one, other, rtol=1e-7, atol=1e-7 * np.abs(one).max(initial=0)):
                raise CannotState("bent")
