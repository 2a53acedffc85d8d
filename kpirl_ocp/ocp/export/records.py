"""Solves in Python that the exported folder is tested against."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.ocp.codegen.target import Target
from kpirl_ocp.ocp.codegen.templates import LICENCE, PREFIX
from kpirl_ocp.ocp.export.constants import numbers
from kpirl_ocp.ocp.interior_point import results
from kpirl_ocp.ocp.problem.guards import dense
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Solver
from kpirl_ocp.types import Array, Solution, Status

STATUS = results.STATUS | {7: Status.FAILED, 8: Status.ITERATION_LIMIT}
"""Values of the C enum kpirl_mpc_status that a solve ends with; 8 is that of the time limit."""
_CODES = {status: code for code, status in reversed(STATUS.items())}


@dataclass(frozen=True)
class Record:
    """A cold start from s0 (n_s,) and, from its solution, a warm start one step along the plan, at after (n_s,)."""

    s0: Array
    context: Array
    after: Array
    cold: Solution
    warm: Solution


def record(problem: OCP, solver: Solver, psi: Array, s0: ArrayLike, context: ArrayLike) -> Record:
    """Solve from s0, then from the next state, for an example of s0 (n_s,) and context (n_c,)."""
    start, psi, goal = problem.inputs(s0, psi, context)
    cold = solver.solve(problem, start, psi, goal)
    after = dense(problem.dynamics(start, cold.actions[0], psi, goal, np.asarray(problem.schedule)[0])).ravel()
    if not cold.status.ok:  # there is nothing to continue from
        return Record(start, goal, start, cold, cold)
    return Record(start, goal, after, cold, solver.solve(problem, after, psi, goal, guess=cold))


def header(records: Sequence[Record], target: Target, periods: Array) -> str:
    """The records as constants of the C test; periods: (T+1+m, n_d), the schedule and m rows that follow it."""
    arrays = {
        "state": [r.s0 for r in records],
        "context": [r.context for r in records],
        "next": [r.after for r in records],
        "cold_actions": [r.cold.actions for r in records],
        "warm_actions": [r.warm.actions for r in records],
        "cold_objective": [np.array([r.cold.objective]) for r in records],
        "warm_objective": [np.array([r.warm.objective]) for r in records],
    }
    guard, name = f"{PREFIX.upper()}_RECORDS_H", f"{PREFIX}_record"
    lines = [f"{LICENCE}\n/* Solved in Python when this folder was exported. */\n#ifndef {guard}\n#define {guard}\n"]
    lines += [f'#include "{PREFIX}.h"\n', f"#define {PREFIX.upper()}_RECORDS {len(records)}\n"]
    for key, values in arrays.items():
        kind = "double" if key.endswith(("actions", "objective")) else f"{PREFIX}_real"
        rows = ",\n".join(f"  {numbers(value.ravel())}" for value in values)
        width = max(values[0].size, 1)
        lines.append(f"static const {kind} {name}_{key}[{len(records)}][{width}] = {{\n{rows}}};\n")
    for key, solutions in (("cold", [r.cold for r in records]), ("warm", [r.warm for r in records])):
        rows = ", ".join(f"{{{code(s, target)}, {s.iterations}}}" for s in solutions)
        lines.append(f"/* status, iterations */\nstatic const int {name}_{key}[{len(records)}][2] = {{{rows}}};\n")
    rows = ",\n".join(f"  {numbers(row)}" for row in periods)
    kind = f"static const {PREFIX}_real {name}_schedule[{len(periods)}][{max(periods.shape[1], 1)}]"
    lines.append(
        f"/* The schedule, and what follows it: period k has the rows from row k on. */\n{kind} = {{\n{rows}}};\n"
    )
    uses = " + ".join(f"(int)sizeof {name}_{key}" for key in (*arrays, "cold", "warm", "schedule"))
    lines.append(f"/* A file may use some of them only. */\nenum {{ {name}_bytes = {uses} }};\n")
    return "\n".join([*lines, "#endif\n"])


def code(solution: Solution, target: Target) -> int:
    """The value of the C enum; see `Target.restores`."""
    if target.restores or solution.status is not Status.INFEASIBLE:
        return _CODES[solution.status]
    return _CODES[Status.ITERATION_LIMIT if solution.iterations >= target.max_iterations else Status.STALLED]
