"""Single-level inverse optimal control (Becanovic, Jovanovic and Bonnet, 2024): one program instead of two nested ones.

    min over w, lambda, psi  sum over demonstrations |z(w) - z_demo|^2
    subject to               dLagrangian/dw (w, lambda; psi) = 0,   g_E(w) = 0,   psi >= 0, sum psi = 1

g_E are the dynamics and all other equalities. The plan is a variable and its optimality a constraint: nothing is ever
planned, and the plan is optimal at the end only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.hypergradients.loss import demonstrated_observations
from kpirl_ocp.ocp.codegen.interrupts import call_solver
from kpirl_ocp.ocp.conditions.program import transcribe
from kpirl_ocp.ocp.problem.guards import dense
from kpirl_ocp.ocp.problem.layout import equality_multipliers, given, limits, n_inequalities, pack
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Guess, Solver
from kpirl_ocp.pictures import Brief
from kpirl_ocp.types import Array, Demonstration

_IPOPT = {"print_level": 0, "sb": "yes", "max_iter": 300, "mu_init": 1e-3}  # a small barrier: the start is feasible
_QUIET = {"print_time": False, "error_on_fail": False}


@dataclass(frozen=True, repr=False)
class SingleLevelResult(Brief):
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
    guess: Guess = None,
    least: ArrayLike = 0.0,
) -> SingleLevelResult:
    """Learn psi >= least with the sum of psi0 (n_psi,), by Ipopt, from the plans for psi0.

    Args:
        problem: without inequalities; equalities are welcome.
        demonstrations: to come near.
        psi0: (n_psi,).
        solver: plans for psi0 from the guess, where the program starts.
        guess: of these plans.
        least: a number or (n_psi,). A little effort keeps costs away under which much is stationary and little optimal.

    Raises:
        ProblemError: bounds or inequalities, as complementarity is no equation that Ipopt could solve.
    """
    if n_inequalities(problem) or np.isfinite(limits(problem)).any():
        raise ProblemError("single-level IOC handles no inequalities: pass problem.unconstrained().")
    if not demonstrations:
        raise ProblemError("learning needs at least one demonstration.")
    program, start, free = transcribe(problem), np.asarray(psi0, float), np.flatnonzero(~given(problem))
    psi = ca.MX.sym("psi", problem.n_parameters)
    variables, guesses, constraints, loss = [psi], [start], [ca.sum1(psi) - start.sum()], ca.MX(0)
    for demo in demonstrations:
        plan = solver.solve(problem, demo.s0, start, demo.context, guess)
        guesses += [pack(plan.trajectory)[free], equality_multipliers(plan.multipliers)]
        unknowns, lam = (ca.MX.sym(name, len(guess)) for name, guess in zip("wl", guesses[-2:], strict=True))
        variables += [unknowns, lam]
        w = ca.MX(pack(plan.trajectory))
        w[free] = unknowns
        constraints += [program.first(w, psi, demo.context, lam, [])[1][free], program.values(w, psi, demo.context)[1]]
        states = ca.reshape(w[: problem.n_states * (problem.horizon + 1)], problem.n_states, problem.horizon + 1)
        loss += ca.sumsqr(problem.observe(states) - demonstrated_observations(problem, demo))
    nlp = {"x": ca.vertcat(*variables), "f": loss / len(demonstrations), "g": ca.vertcat(*constraints)}
    ipopt = ca.nlpsol("single_level", "ipopt", nlp, {"ipopt": _IPOPT, **_QUIET})
    lower = np.full(nlp["x"].numel(), -np.inf)
    lower[: len(start)] = np.broadcast_to(np.asarray(least, float), start.shape)
    result = call_solver(ipopt, x0=np.concatenate(guesses), lbx=lower, ubx=np.inf, lbg=0, ubg=0)
    stats = ipopt.stats()
    learned = dense(result["x"]).ravel()[: len(start)]
    return SingleLevelResult(learned, float(result["f"]), bool(stats["success"]), str(stats["return_status"]))
