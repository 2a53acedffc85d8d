"""Tests of the derivatives at a computed solution, by evaluations nearby.

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

from typing import NamedTuple

import numpy as np

from kpirl_ocp.ocp.codegen.numpy_calls import call
from kpirl_ocp.ocp.conditions.hessian_products import kink
from kpirl_ocp.ocp.sensitivity.factorisation import Factorisation
from kpirl_ocp.ocp.sensitivity.kkt_system import KKTSystem, PrimalDual
from kpirl_ocp.types import Array

_KNOWN = 1e-9  # relative accuracy to which no solution is known better
_DIFFERENCE = 1e-6  # step of the difference quotient, relative to w: truncation about 1e-12, rounding about 1e-10


class Nearby(NamedTuple):
    """The neighbourhood that a Newton step leads to.

    point: after the step, with w moved a little further along the softest direction.
    step: length of the step, relative to 1 + |w|; the error of the solution.
    margin: smallest multiplier of an active and slack of an inactive row after the step, negative if the active set
        was wrong; infinite without inequalities, or when they are smoothed.
    """

    point: PrimalDual
    step: float
    margin: float


def newton_step(system: KKTSystem, factors: Factorisation) -> Nearby:
    """One Newton step on the KKT conditions with this active set."""
    point, move = system.point, factors.newton_step()
    forces, slack = system.pushing + move.forces, system.slack - system.times_rows(move.w)
    margins = np.where(system.active, forces, slack)[~system.equal]
    margin = np.inf if system.instance.barrier > 0 else float(np.min(margins, initial=np.inf))
    size = 1 + float(np.abs(point.w).max())
    w = point.w + move.w
    nearby = PrimalDual(w + _KNOWN * size * factors.softest, point.costates + move.costates, forces)
    return Nearby(nearby, float(np.abs(w - point.w).max()) / size, margin)


def kink_along(system: KKTSystem, direction: Array) -> float:
    """Relative disagreement of the Lagrangian's gradient, differenced along a direction (n_w,), with the Hessian."""
    size = np.abs(direction).max(initial=0.0)
    if size == 0:
        return 0.0
    instance, point = system.instance, system.point
    step = _DIFFERENCE * (1 + np.abs(point.w).max()) / size
    at = *instance.arguments(point), system.H, system.H_last
    ((whole, part),) = call(instance.problem, kink)(*at, direction, step)
    ratio = float(part / whole) if whole != 0 else 0.0
    return ratio if np.isfinite(ratio) else np.inf
