"""Can the derivatives at a computed solution be believed? Four questions, answered by evaluating nearby.

A solution is only known to the solver's tolerance, so the active set was guessed, and second derivatives were taken
beside the true solution. One Newton step on the KKT conditions leads (quadratically) closer to it:

* distance: the step itself must be small;
* signs: every multiplier of an active row and every slack of an inactive one must be positive after it;
* stability: the adjoint, solved again after it, must be the same. The step is lengthened by 1e-9 along the softest
  direction, because no solution is known better than that: at a fold or a flat minimum the adjoint then explodes;
* smoothness: the gradient of the Lagrangian, differenced along the adjoint, must agree with the Hessian. At a kink
  (ReLU, max, norm) it does not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kpirl_ocp.ocp.kkt import transcribe
from kpirl_ocp.ocp.problem import OCP
from kpirl_ocp.ocp.sensitivity import Factorisation, KKTSystem, PrimalDual, linearise, path_forces, scatter
from kpirl_ocp.types import Array

_KNOWN = 1e-9  # relative accuracy to which no solution is known better
_DIFFERENCE = 1e-6  # step of the difference quotient, relative to w: truncation about 1e-12, rounding about 1e-10


@dataclass(frozen=True)
class Probe:
    """What was found nearby.

    step: length of the Newton step, relative to 1 + |w|; the error of the solution.
    margin: smallest multiplier of an active and slack of an inactive row after the Newton step, negative if the active
        set was wrong; infinite without inequalities, or when they are smoothed.
    change: relative change of the adjoint after the step.
    kink: relative disagreement of the differenced gradient with the Hessian along the adjoint.
    """

    step: float
    margin: float
    change: float
    kink: float


def probe(
    problem: OCP,
    s0: Array,
    psi: Array,
    context: Array,
    system: KKTSystem,
    factors: Factorisation,
    barrier: float,
    right: Array,
    adjoint: Array,
) -> Probe:
    """Probe the surroundings of a solution whose adjoint for the right-hand side `right` is `adjoint`, both (n_w,)."""
    refined, margin = _newton(system, factors, barrier)
    size = 1 + float(np.abs(system.point.w).max())
    step = float(np.abs(refined.w - system.point.w).max()) / size
    soft = _KNOWN * size * factors.softest
    nearby = PrimalDual(refined.w + soft, refined.costates, refined.forces)
    again = linearise(problem, s0, psi, context, nearby, system.active, barrier)
    change = np.inf
    if again.finite:
        moved = Factorisation(again).solve(right, np.zeros(system.n_defects), np.zeros(int(system.active.sum())))[0]
        change = _relative(moved - adjoint, adjoint)
    return Probe(step, margin, change, _kink(problem, s0, psi, context, system, adjoint))


def _newton(system: KKTSystem, factors: Factorisation, barrier: float) -> tuple[PrimalDual, float]:
    """One Newton step on the KKT conditions with this active set, and the smallest margin after it."""
    point, active = system.point, system.active
    forces = np.where(active, point.forces, 0.0)
    if barrier > 0:
        with np.errstate(divide="ignore"):
            forces = np.where(system.equal, forces, barrier / system.slack)
    unbalanced = system.gradient + system.rows.T @ forces
    dw, costates, pushes, _ = factors.solve(-unbalanced, -system.defects, system.slack[active])
    forces, slack = forces + scatter(active, pushes), system.slack - system.rows @ dw
    margins = np.where(active, forces, slack)[~system.equal]
    margin = np.inf if barrier > 0 else float(np.min(margins, initial=np.inf))
    return PrimalDual(point.w + dw, point.costates + costates, forces), margin


def _kink(problem: OCP, s0: Array, psi: Array, context: Array, system: KKTSystem, adjoint: Array) -> float:
    size = np.abs(adjoint).max(initial=0.0)
    if size == 0:
        return 0.0
    point, first = system.point, transcribe(problem).first
    step = _DIFFERENCE * (1 + np.abs(point.w).max()) / size
    mu = path_forces(problem, point.forces)
    ends = [first(point.w + sign * step * adjoint, s0, psi, context, point.costates, mu)[1] for sign in (1, -1)]
    difference = (np.array(ends[0]) - np.array(ends[1])).ravel() / (2 * step)
    return _relative(difference - system.hessian @ adjoint, difference)


def _relative(part: Array, whole: Array) -> float:
    """|part| / |whole|; NaN and infinity count as infinite."""
    size = float(np.linalg.norm(whole))
    ratio = float(np.linalg.norm(part)) / size if size > 0 else 0.0
    return ratio if np.isfinite(ratio) else np.inf
