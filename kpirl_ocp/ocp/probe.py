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

from dataclasses import dataclass, replace

import numpy as np

from kpirl_ocp.ocp.factorisation import Factorisation
from kpirl_ocp.ocp.sensitivity import Instance, KKTSystem, PrimalDual, linearise
from kpirl_ocp.types import Array

_KNOWN = 1e-9  # relative accuracy to which no solution is known better
_SOLVED = 1e-6  # relative residual of the adjoint after the step; above it the old factors are of no use there
_NOTHING = 1e-8  # an adjoint this much shorter than a free one is zero up to rounding: the constraints leave no freedom
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


def probe(instance: Instance, system: KKTSystem, factors: Factorisation, right: Array, adjoint: Array) -> Probe:
    """Probe the surroundings of a solution whose adjoint for the right-hand side `right` is `adjoint`, both (n_w,)."""
    refined, margin = _newton(instance, system, factors)
    size = 1 + float(np.abs(system.point.w).max())
    step = float(np.abs(refined.w - system.point.w).max()) / size
    nearby = replace(refined, w=refined.w + _KNOWN * size * factors.softest)
    again = linearise(instance, nearby, system.active)
    change = np.inf
    if again.finite:
        nothing = np.zeros(len(system.defects)), np.zeros(len(system.active))
        moved, *_, residual = factors.solve(right, *nothing, again)
        change = _relative(moved - adjoint, adjoint, _NOTHING * factors.size(right)) if residual <= _SOLVED else np.inf
    return Probe(step, margin, change, _kink(instance, system, adjoint))


def _newton(instance: Instance, system: KKTSystem, factors: Factorisation) -> tuple[PrimalDual, float]:
    """One Newton step on the KKT conditions with this active set, and the smallest margin after it."""
    point, active, smoothed = system.point, system.active, instance.barrier > 0
    forces = np.where(active, point.forces, 0.0)
    if smoothed:
        with np.errstate(divide="ignore"):
            forces = np.where(system.equal, forces, instance.barrier / system.slack)
    path = np.arange(len(forces)) >= len(forces) - len(instance.path_forces(forces))
    unbalanced = system.gradient + system.times_transposed_rows(forces - np.where(path, point.forces, 0.0))
    dw, costates, pushes, _ = factors.solve(-unbalanced, -system.defects, np.where(active, system.slack, 0.0))
    forces, slack = forces + pushes, system.slack - system.times_rows(dw)
    margins = np.where(active, forces, slack)[~system.equal]
    margin = np.inf if smoothed else float(np.min(margins, initial=np.inf))
    return PrimalDual(point.w + dw, point.costates + costates, forces), margin


def _kink(instance: Instance, system: KKTSystem, adjoint: Array) -> float:
    """Central difference of the Lagrangian's gradient along the adjoint, against the Hessian."""
    size = np.abs(adjoint).max(initial=0.0)
    if size == 0:
        return 0.0
    point = system.point
    step = _DIFFERENCE * (1 + np.abs(point.w).max()) / size
    right, left = (instance.gradient(replace(point, w=point.w + sign * step * adjoint)) for sign in (1, -1))
    difference = (right - left) / (2 * step)
    return _relative(difference - system.times_hessian(adjoint), difference)


def _relative(part: Array, whole: Array, floor: float = 0.0) -> float:
    """|part| / |whole|, the latter at least `floor`; NaN and infinity count as infinite."""
    size = max(float(np.linalg.norm(whole)), floor)
    ratio = float(np.linalg.norm(part)) / size if size > 0 else 0.0
    return ratio if np.isfinite(ratio) else np.inf
