"""Identifiability of a learned cost from the data: intervals of its weights, and how many directions are known.

Before learning, every coordinate could have a weight as large as the random starts, or as the weights turned out
where those are larger, and every step or kernel as much more again (the spread); the same in units of equal stiffness.
Misfit counts as noise, and no detector is exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kpirl_ocp.irl.hypergradients.certificate import Hypergradient
from kpirl_ocp.irl.hypergradients.implicit import Implicit
from kpirl_ocp.irl.hypergradients.unrolled import Unrolled
from kpirl_ocp.irl.identifiability.gains import squared_gains, stiffness
from kpirl_ocp.irl.identifiability.identify import identify
from kpirl_ocp.irl.visual.learning import CONVERGED, InnerLoop, LearnedPlan, horizon_of
from kpirl_ocp.irl.visual.planning_costs import learning_problem
from kpirl_ocp.ocp.models.keypoint_dynamics import NetworkDynamics
from kpirl_ocp.perception.dynamics.augmentation import DETECTION
from kpirl_ocp.types import Array, Demonstration
from reproduction.sweep import Result

HALF = 5  # steps: weights early and late are those of the first and of the last five
LEVEL = 0.9


def identified(
    dynamics: NetworkDynamics, demonstrations: Sequence[Demonstration], learned: LearnedPlan, inner: InnerLoop
) -> Result:
    """Intervals and known directions of a cost that was learned by its IRL loss and has no parameters but weights.

    halfwidths, determined: (3, n_z) of 90 % intervals of weights averaged over all, the first and the last steps, and
    whether the data determine them; axis_halfwidths, axes_determined: (2,) of x and y in the mean over time and
    keypoints. gains: (n_z,) squared. known, known_in_stiffness: directions, in either unit.
    """
    converged = learned.cost.solver is CONVERGED
    horizon, n_z = horizon_of(demonstrations), dynamics.n_z
    problem, family, psi = learning_problem(dynamics, learned.family, horizon), learned.family, learned.psi
    method: Hypergradient = Implicit(CONVERGED, policy="flag") if converged else Unrolled(inner.solver)
    basis, slope = family.basis.matrix(horizon), weight_slopes(family.positivity, psi)
    plans = [learned.cost.solver.solve(problem, demo.s0, psi, demo.context) for demo in demonstrations]
    gains = np.mean([squared_gains(problem, plan.trajectory, psi) for plan in plans], axis=0)  # (T, n_z)
    size = max(1 / inner.effort if converged else 1.0, float(np.sqrt(np.mean(learned.cost.weights**2))))
    unit = size / slope
    rows = averages(basis, n_z) * slope
    noise = max(DETECTION, float(np.sqrt(learned.losses[learned.best] / (horizon * n_z))))
    together = alike(basis.shape[1], n_z)
    found = identify(problem, demonstrations, psi, unit[:, None] * together, noise, method)
    stiff = stiffness(basis, gains, slope.reshape(-1, n_z))
    moving = stiff > 1e-9 * stiff.max()
    even = unit.copy()
    even[moving] = np.exp(np.log(unit[moving] * stiff[moving]).mean()) / stiff[moving]
    compared = replace(found, spread=even[:, None] * together)
    axes = np.array([rows[axis:n_z:2].mean(axis=0) for axis in (0, 1)])
    widths, along = (np.ptp(found.credible_intervals(LEVEL, some), axis=1) / 2 for some in (rows, axes))
    return {
        "halfwidths": widths.reshape(3, n_z),
        "determined": found.determined(rows).reshape(3, n_z),
        "axis_halfwidths": along,
        "axes_determined": found.determined(axes),
        "gains": gains.mean(axis=0),
        "known": found.known(),
        "known_in_stiffness": compared.known(),
        "parameters": len(psi),
        "noise": noise,
        "uncertified": found.uncertified,
    }


def alike(kernels: int, n_z: int) -> Array:
    """S (J n_z, J n_z): every parameter has a variance of one that its coordinate's kernels share, and one more."""
    return np.kron(np.linalg.cholesky(np.eye(kernels) + np.ones((kernels, kernels))), np.eye(n_z))


def averages(basis: Array, n_z: int) -> Array:
    """(3 n_z, J n_z): weights averaged over all, the first and the last steps, as combinations of Psi row by row."""
    parts = [basis.mean(axis=0), basis[:HALF].mean(axis=0), basis[-HALF:].mean(axis=0)]
    return np.vstack([np.kron(part, np.eye(n_z)) for part in parts])


def weight_slopes(positivity: str, psi: Array) -> Array:
    """g'(psi) (n_psi,) of the map from parameters to weights; not below 1e-9, for weights that are zero to rounding."""
    with np.errstate(over="ignore"):
        slopes = {"identity": np.ones_like(psi), "softplus": 1 / (1 + np.exp(-psi))}[positivity]
    return np.maximum(slopes, 1e-9)
