"""The arrays of a solution as the C code is given them."""

from __future__ import annotations

from typing import Any

import numpy as np

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.interior_point import library as c
from kpirl_ocp.ocp.problem.layout import check_multipliers
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array, Solution, floats


def check_solution(problem: OCP, solution: Solution) -> None:
    """Raise ProblemError when the arrays of a solution do not fit the problem."""
    steps, n_s, n_u = problem.horizon, problem.n_states, problem.n_actions
    shapes = {"states": (steps + 1, n_s), "actions": (steps, n_u)}
    for name, shape in shapes.items():
        given = floats(f"the solution's {name}", getattr(solution, name)).shape
        if given != shape:
            raise ProblemError(f"the solution's {name} must be {shape}, got {given}: it is of another problem.")
    check_multipliers(problem, solution.multipliers, "solution")


def solution_arrays(solution: Solution) -> list[Array]:
    """Those that the structure `kpirl_mpc_solution` shows, in its order."""
    m = solution.multipliers
    parts = [solution.states, solution.actions, m.dynamics, m.state, m.action]
    parts += [m.path, m.terminal, m.path_equality, m.terminal_equality]
    return [np.ascontiguousarray(part, float) for part in parts]


def structure_of(arrays: list[Array]) -> Any:
    """`kpirl_mpc_solution`. It does not keep the arrays."""
    return c.SolutionArrays(*map(c.address_of, arrays))
