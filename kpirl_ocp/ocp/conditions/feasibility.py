"""The least violation of the constraints near a point, for solvers that do not say why they gave up.

    minimise  |g_E(w)|^2 / 2 + |g_I(w) + y|^2 / 2     over w within its bounds and y >= 0

A minimum above zero shows that there is none nearby: no small change of w violates the constraints less.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.codegen.interrupts import call_solver
from kpirl_ocp.ocp.conditions.program import limits_from, transcribe
from kpirl_ocp.ocp.problem.layout import n_inequalities
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array, largest

_CLOSE = 1e-6  # largest violation that counts as none


def infeasible(problem: OCP, points: Iterable[Array], s0: Array, psi: Array, context: Array) -> bool:
    """True if the least violation near each of some points w (n_w,) was found, and is above 1e-6."""
    return all(_infeasible_near(problem, w, s0, psi, context) for w in points)


def _infeasible_near(problem: OCP, w: Array, s0: Array, psi: Array, context: Array) -> bool:
    if not np.isfinite(w).all():
        return False
    solver, values = _least_violation(problem)
    lower, upper = limits_from(problem, s0)
    p = np.concatenate([psi, context])
    _, g_I = np.split(np.array(values(w, p)).ravel(), [transcribe(problem).n_equalities])
    slack, n_w = np.maximum(-g_I, 0.0), len(w)
    found = call_solver(
        solver,
        x0=np.concatenate([w, slack]),
        p=p,
        lbx=np.concatenate([lower, np.zeros(len(slack))]),
        ubx=np.concatenate([upper, np.full(len(slack), np.inf)]),
    )
    x = np.array(found["x"]).ravel()
    rows = np.array(values(x[:n_w], p)).ravel()
    rows[len(rows) - len(slack) :] += x[n_w:]
    return bool(solver.stats()["success"]) and largest(rows) > _CLOSE


@lru_cache(maxsize=64)
def _least_violation(problem: OCP) -> tuple[ca.Function, ca.Function]:
    """The solver, and (w, p) -> g."""
    program = transcribe(problem)
    w, *numbers = program.symbols
    p, rows = ca.vertcat(*numbers), program.rows
    slack = ca.MX.sym("y", n_inequalities(problem))
    violation = rows + ca.vertcat(ca.MX(rows.numel() - slack.numel(), 1), slack)
    quiet = {"print_time": False, "show_eval_warnings": False}
    settings = {"tol": 1e-8, "max_iter": 200, "print_level": 0, "sb": "yes", "bound_relax_factor": 0.0}
    nlp = {"x": ca.vertcat(w, slack), "p": p, "f": ca.sumsqr(violation) / 2}
    return ca.nlpsol("violation", "ipopt", nlp, {"ipopt": settings, **quiet}), ca.Function("rows", [w, p], [rows])
