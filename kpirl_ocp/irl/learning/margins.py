"""Rules of apprenticeship learning: the next cost psi (|psi| = 1) from the features of all plans and of the expert.

Each takes mu (k, n) of the plans so far and mu_E (n,), and gives psi (n,) with min_j psi . (mu_j - mu_E), or zeros and
a margin of zero where its conditions have no solution. Signs are those of a cost, which is to be low for the expert.
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.problem.guards import dense
from kpirl_ocp.types import Array

Rule = Callable[[Array, Array], tuple[Array, float]]


def largest_margin(found: Array, expert: Array) -> tuple[Array, float]:
    """argmax min_j psi . (mu_j - mu_E) over |psi| <= 1 (Abbeel and Ng, 2004, section 3)."""
    return max_margin(found - expert)


def two_sided(found: Array, expert: Array) -> tuple[Array, float]:
    """min |psi|^2 subject to psi . mu_E <= -1 and psi . mu_j >= 1: the program of the code that the paper cites.

    It separates all features from each other and from zero, so that it has no solution where mu_E is zero.
    """
    psi = _shortest(np.vstack([-expert, found]))
    return psi, float(((found - expert) @ psi).min())


def projection(found: Array, expert: Array) -> tuple[Array, float]:
    """mu_bar - mu_E, with mu_bar the point towards mu_E on the line from it to each new mu (ibid., section 3.1)."""
    nearest = found[0]
    for mu in found[1:]:
        line = mu - nearest
        length = line @ line
        nearest = nearest + (line @ (expert - nearest) / length * line if length > 0 else 0.0)
    psi = nearest - expert
    distance = np.linalg.norm(psi)
    return (psi / distance, float(distance)) if distance > 0 else (psi, 0.0)


def max_margin(differences: Array) -> tuple[Array, float]:
    """The unit psi (n,) with the largest min_j psi . differences[j], and that margin; (0, 0) if none is positive."""
    psi = _shortest(differences)
    margin = float((differences @ psi).min())
    return (psi, margin) if margin > 0 else (np.zeros_like(psi), 0.0)


def _shortest(rows: Array) -> Array:
    """The shortest psi with rows . psi >= 1, scaled to length one; zeros if there is none."""
    n, size = rows.shape[1], np.abs(rows).max()
    if size == 0:
        return np.zeros(n)
    structure = {"h": ca.Sparsity.diag(n), "a": ca.Sparsity.dense(*rows.shape)}
    solver = ca.conic("max_margin", "daqp", structure, {"error_on_fail": False, "print_time": False})
    result = solver(h=ca.DM.eye(n), g=0, a=rows / size, lba=1, uba=np.inf)  # tolerances mean the same in all units
    psi = dense(result["x"]).ravel()
    length, holds = np.linalg.norm(psi), (rows @ psi >= (1 - 1e-6) * size).all()  # DAQP passes over rows of zeros
    return psi / length if solver.stats()["success"] and holds else np.zeros(n)
