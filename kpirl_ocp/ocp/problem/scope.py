"""Features of problems, and the refusal of those that a solver does not support."""

from __future__ import annotations

import numpy as np

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array


def features(problem: OCP) -> dict[str, bool]:
    """Features that a problem may have beyond bounds and path constraints: True for those that this one has."""
    return {
        "path equalities": problem.n_path_equality > 0,
        "terminal inequalities (or path constraints on states alone)": problem.n_terminal > 0,
        "terminal equalities": problem.n_terminal_equality > 0,
        "dynamics that see the context or the schedule": problem.dynamics_see_stage,
        "a free initial state": bool(problem.free_start.any()),
        "bounds that change from stage to stage": _varies(problem),
        "no actions": problem.n_actions == 0,
    }


def refuse_features(problem: OCP, solver: str, alternative: str = "Riccati() or Ipopt()") -> None:
    """Raise ProblemError, naming them and an alternative, if the problem has any of `features`."""
    found = [name for name, present in features(problem).items() if present]
    if found:
        raise ProblemError(f"{solver} does not handle {', '.join(found)}: use {alternative}.")


def constant_bounds(problem: OCP) -> list[Array]:
    """Lower and upper bounds (n_s,) of s_1 .. s_T, then (n_u,) of actions, for a problem in which they are constant."""
    pairs = [np.asarray(bound)[1:] for bound in problem.state_bounds], map(np.asarray, problem.action_bounds)
    return [bound[0] for pair in pairs for bound in pair]


def _varies(problem: OCP) -> bool:
    bounds = [*(np.asarray(bound)[1:] for bound in problem.state_bounds), *map(np.asarray, problem.action_bounds)]
    return any((bound != bound[:1]).any() for bound in bounds)
