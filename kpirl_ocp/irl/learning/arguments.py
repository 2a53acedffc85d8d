"""Checks of what learning is given; every refusal is one sentence that names the argument."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.problem.statement.checks import numbers, shown, vector
from kpirl_ocp.types import Array, Demonstration


def check_demonstrations(demonstrations: object, guesses: object) -> None:
    """Raise ProblemError unless there are demonstrations, and a guess for each if there are guesses."""
    if not isinstance(demonstrations, Sequence) or not all(isinstance(one, Demonstration) for one in demonstrations):
        raise ProblemError(f"demonstrations must be a sequence of Demonstration, got {shown(demonstrations)}.")
    if not demonstrations:
        raise ProblemError("learning needs at least one demonstration.")
    if guesses is not None and (not isinstance(guesses, Sequence) or len(guesses) != len(demonstrations)):
        count = len(demonstrations)
        raise ProblemError(f"there must be {count} guesses, one per demonstration, got {shown(guesses)}.")


def check_methods(hypergradient: object, optimiser: object) -> None:
    """Raise ProblemError unless they are configured objects, not classes or names."""
    if isinstance(hypergradient, type) or not callable(hypergradient):
        raise ProblemError(f"hypergradient must be an object such as Implicit(), got {shown(hypergradient)}.")
    if isinstance(optimiser, type) or not hasattr(optimiser, "step"):
        raise ProblemError(f"optimiser must be an object such as Adam(), got {shown(optimiser)}.")


def check_bounds(bounds: Any) -> None:
    """Raise ProblemError unless they are a pair."""
    if not isinstance(bounds, Sequence | np.ndarray) or len(bounds) != 2:
        raise ProblemError(f"bounds must be (lower, upper), got {shown(bounds)}.")


def check_run(steps: object, callback: object) -> None:
    """Raise ProblemError unless steps can be counted and the callback can be called."""
    if not isinstance(steps, int | np.integer) or isinstance(steps, bool) or steps < 0:
        raise ProblemError(f"steps must be a whole number of at least 0, got {shown(steps)}.")
    if callback is not None and not callable(callback):
        raise ProblemError(f"callback must be a function of the state, got {shown(callback)}.")


def psi_of(psi0: ArrayLike, length: int) -> Array:
    """A copy of psi0 (n_psi,). Raises ProblemError for another length, NaN and infinity."""
    psi = np.array(vector("psi0", psi0, length))
    if not np.isfinite(psi).all():
        raise ProblemError(f"psi0 must be finite, got {shown(psi0)}.")
    return psi


def scale_of(scale: ArrayLike, length: int) -> Array:
    """The scale (n_psi,) of a number or (n_psi,). Raises ProblemError unless it is positive."""
    found = numbers("scale", scale)
    if found.shape not in ((), (length,)) or not (np.isfinite(found) & (found > 0)).all():
        raise ProblemError(f"scale must be positive, a number or ({length},), got {shown(scale)}.")
    return np.broadcast_to(found, (length,))
