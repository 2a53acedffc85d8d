"""Single-level inverse optimal control (Becanovic, Jovanovic and Bonnet, 2024): one program instead of two nested ones.

    min over w, lambda, psi  sum over demonstrations |z(w) - z_demo|^2
    subject to               dLagrangian/dw (w, lambda; psi) = 0,   f(s, u) - s_next = 0,   psi >= 0, sum psi = 1

The plan is a variable, optimality a constraint: nothing is ever planned, and a plan is optimal at the end only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.hypergradients.certificate import seen
from kpirl_ocp.ocp.conditions.nlp import pack, transcribe
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Solver
from kpirl_ocp.types import Array, Demonstration

_IPOPT = {"print_level": 0, "sb": "yes", "mu_init": 1e-3}  # a small barrier: the start is feasible
_QUIET = {"print_time": False, "error_on_fail": False}


@dataclass(frozen=True)
class SingleLevelResult:
    """psi: (n_psi,). loss: mean IRL loss of the plans in the program. success, status: what Ipopt says."""

    psi: Array
    loss: float
    success: bool
    status: str


def single_level(
    problem: OCP,
    demonstrations: Sequence[Demonstration],
    psi0: ArrayLike,
    solver: Solver,
    max_iterations: int = 300,
) -> SingleLevelResult:
    """Learn psi >= 0 with the sum of psi0 (n_psi,), by Ipopt, from the plans for psi0.

    problem: without inequalities. solver: plans for psi0, where the program starts.

    Raises ProblemError for bounds and path constraints: complementarity is no equation that Ipopt could solve.
    """
    if problem.has_action_bounds or problem.has_state_constraints:
        raise ProblemError("single-level IOC knows no inequalities: pass problem.unconstrained().")
    if not demonstrations:
        raise ProblemError("learning needs at least one demonstration.")
    nlp, start = transcribe(problem), np.asarray(psi0, float)
    psi = ca.MX.sym("psi", problem.n_parameters)
    variables, guesses, constraints, loss = [psi], [start], [ca.sum1(psi) - start.sum()], ca.MX(0)
    for number, demo in enumerate(demonstrations):
        w = ca.MX.sym(f"w{number}", len(nlp.lower))
        costates = ca.MX.sym(f"lambda{number}", nlp.n_defects)
        point = (w, demo.s0, psi, demo.context)
        constraints += [nlp.first(*point, costates, [])[1], nlp.values(*point)[1]]
        states = ca.horzcat(demo.s0, ca.reshape(w[: nlp.n_defects], problem.n_states, problem.horizon))
        loss += ca.sumsqr(problem.observe(states) - seen(problem, demo))
        plan = solver.solve(problem, demo.s0, start, demo.context)
        variables += [w, costates]
        guesses += [pack(plan.trajectory), plan.multipliers.dynamics.ravel()]
    program = {"x": ca.vertcat(*variables), "f": loss / len(demonstrations), "g": ca.vertcat(*constraints)}
    ipopt = ca.nlpsol("single_level", "ipopt", program, {"ipopt": _IPOPT | {"max_iter": max_iterations}, **_QUIET})
    lower = np.full(program["x"].numel(), -np.inf)
    lower[: len(start)] = 0.0
    result = ipopt(x0=np.concatenate(guesses), lbx=lower, ubx=np.inf, lbg=0, ubg=0)
    stats = ipopt.stats()
    learned = np.array(result["x"]).ravel()[: len(start)]
    return SingleLevelResult(learned, float(result["f"]), bool(stats["success"]), str(stats["return_status"]))
