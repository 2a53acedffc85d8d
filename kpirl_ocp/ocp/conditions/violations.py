"""Which constraint a plan breaks, in the words in which the problem was stated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kpirl_ocp.ocp.conditions.program import transcribe
from kpirl_ocp.ocp.problem.guards import dense
from kpirl_ocp.ocp.problem.layout import limits, pack, unpack_multipliers
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array, Multipliers, Solution, Status, Trajectory

_STATED = {
    "dynamics": "dynamics",
    "state": "state_bounds",
    "action": "action_bounds",
    "path": "path_constraint",
    "path_equality": "path_equality",
    "terminal": "terminal_constraint",
    "terminal_equality": "terminal_equality",
}


def violations(problem: OCP, psi: Array, context: Array, trajectory: Trajectory) -> Multipliers:
    """By how much each constraint is violated, in its own units: arrays that belong to rows as multipliers do."""
    w = pack(trajectory)
    lower, upper = limits(problem)
    _, g_E, g_I = (dense(value).ravel() for value in transcribe(problem).values(w, psi, context))
    beyond = np.maximum(np.maximum(lower - w, w - upper), 0)
    return unpack_multipliers(problem, beyond, np.abs(g_E), np.maximum(g_I, 0))


def explained(problem: OCP, found: Solution) -> Solution:
    """The solution; an infeasible one says which constraint it violates most."""
    if found.status is not Status.INFEASIBLE:
        return found
    worst = worst_violation(problem, found.psi, found.context, found.trajectory)
    return replace(found, message="; ".join(filter(None, [found.message, worst])))


def worst_violation(problem: OCP, psi: Array, context: Array, trajectory: Trajectory) -> str:
    """The largest violation in a sentence, as "path_constraint[2] at step 7 is violated most, by 0.31".

    Empty where no constraint is violated.
    """
    rows = vars(violations(problem, psi, context, trajectory))
    name = max(rows, key=lambda name: np.max(rows[name], initial=0.0))
    size = np.max(rows[name], initial=0.0)
    if size == 0:
        return ""
    *step, row = (int(i) for i in np.unravel_index(rows[name].argmax(), rows[name].shape))
    return f"{_stated(problem, name, row)} at {_when(problem, name, step)} is violated most, by {size:.3g}"


def _stated(problem: OCP, name: str, row: int) -> str:
    """A row by the argument of `OCP.from_expressions` that states it; rows of h that hold at s_T come first there."""
    if name == "terminal" and row < len(problem.state_rows):
        name, row = "path", problem.state_rows[row]
    elif name == "terminal":
        row -= len(problem.state_rows)
    return f"{_STATED[name]}[{row}]"


def _when(problem: OCP, name: str, step: list[int]) -> str:
    last = not step or (name == "state" and step[0] == problem.horizon)
    return "the end" if last else f"step {step[0]}"
