"""A problem in one line, as `print` shows it."""

from __future__ import annotations

import numpy as np

from kpirl_ocp.ocp.problem.statement.checks import Bounds
from kpirl_ocp.ocp.problem.statement.dimensions import Dimensions


def summary(problem: Dimensions) -> str:
    """Its sizes, with states and actions that a statement has added; what is absent is left out."""
    counts = {
        "state": problem.n_states,
        "action": problem.n_actions,
        "parameter": problem.n_parameters,
        "context number": problem.n_context,
        "schedule number": np.asarray(problem.schedule).shape[1],
        "free initial state": int(problem.free_start.sum()),
        "bounded state": _bounded(problem.limits),
        "bounded action": _bounded(problem.action_bounds),
        "path constraint": problem.n_path,
        "path equation": problem.n_path_equality,
        "terminal constraint": problem.n_terminal,
        "terminal equation": problem.n_terminal_equality,
    }
    return ", ".join(f"{n} {name}{'s' * (n != 1)}" for name, n in counts.items() if n)


def _bounded(bounds: Bounds) -> int:
    """Entries with a finite bound at some stage."""
    return int(np.isfinite(np.asarray(bounds)).any(axis=(0, 1)).sum())
