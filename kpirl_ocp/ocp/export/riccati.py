"""The interior-point method as C: the core's sources, the problem's stage functions, and where their results belong."""

from __future__ import annotations

import ctypes

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.codegen.portable_c import STAGE
from kpirl_ocp.ocp.codegen.target import Target
from kpirl_ocp.ocp.codegen.templates import PREFIX
from kpirl_ocp.ocp.conditions.structure import quadratic_program
from kpirl_ocp.ocp.export.stages import exported_stages, pulls
from kpirl_ocp.ocp.interior_point import library as core
from kpirl_ocp.ocp.interior_point.core import dimensions_of, point_bounds
from kpirl_ocp.ocp.interior_point.stage_functions import StageFunctions
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.solvers.riccati import Riccati

_MATRICES = ("F", "G", "E", "H")


def target(problem: OCP, solver: Riccati) -> Target:
    """Values, first and second derivatives of a stage and of the end, and the pull-back of psi and the context."""
    stages, pulled = exported_stages(problem), pulls(problem)
    interfaces = {function.name(): STAGE for function in stages.all} | {f.name(): "pull" for f in pulled}
    return Target(
        kind="riccati",
        functions=[*stages.all, *pulled],
        interfaces=interfaces,
        transition="stage_values",
        sources=("riccati.h", "riccati.c", "interface.h", "adjoint.c"),
        with_core=True,
        workspace="riccati.h",
        macros=_memory(problem, stages),
        data=_model(stages, quadratic_program(problem)),
        steps=solver.steps or 0,
        max_iterations=solver.max_iterations,
        tolerance=solver.tolerance,
        barrier=solver.barrier,
        single_tolerance=1e-5,
    )


def _memory(problem: OCP, stages: StageFunctions) -> dict[str, int]:
    """The memory that the core takes, as it counts it."""
    lower, upper, free = point_bounds(problem)
    bounds = core.Bounds(lower.ctypes.data, upper.ctypes.data, free.ctypes.data, len(free))
    nonzeros = {name: core.Pattern(sparsity.nnz(), None) for name, sparsity in _sparsities(stages).items()}
    dimensions, model, count = dimensions_of(problem), core.Model(by_stage=1, **nonzeros), core.Count()
    core.library().kpirl_mpc_count_core(*(ctypes.addressof(x) for x in (dimensions, bounds, model, count)))
    return {f"CORE_{name.upper()}": getattr(count, name) for name in ("head", "reals", "integers", "arrays")}


def _sparsities(stages: StageFunctions) -> dict[str, ca.Sparsity]:
    """Of the matrices, by their names in `kpirl_mpc_model`."""
    second = {"": stages.stage[2], "_last": stages.last[2]}
    return {
        f"{matrix}{end}": function.sparsity_out(matrix)
        for end, function in second.items()
        for matrix in _MATRICES
        if matrix in function.name_out()
    }


def _model(stages: StageFunctions, quadratic: bool) -> str:
    """The functions behind pointers, and the patterns of their matrices."""
    tables, members = [], ["    .by_stage = 1,\n", f"    .quadratic = {quadratic:d},\n"]
    for which, levels in (("stage", stages.stage), ("last", stages.last)):
        pointers = ", ".join(f"{{{PREFIX}_{one.name()}, NULL}}" for one in levels)
        members.append(f"    .{which} = {{{pointers}}},\n")
    for name, sparsity in _sparsities(stages).items():
        places, table = _places(sparsity), "NULL"
        if places:
            table = f"entries_{name}"
            tables.append(f"static const int {table}[] = {{{', '.join(map(str, places))}}};\n")
        members.append(f"    .{name} = {{{sparsity.nnz()}, {table}}},\n")
    return (
        "\n/* Functions of values, first and second derivatives; nonzeros of matrices in dense arrays by columns. */\n"
        f"{''.join(tables)}\n"
        f"const {PREFIX}_model {PREFIX}_exported_model = {{\n{''.join(members)}}};\n"
    )


def _places(sparsity: ca.Sparsity) -> list[int]:
    """Of the nonzeros, column by column; none where every entry is one."""
    if sparsity.is_dense():
        return []
    rows, columns = (np.array(side, int) for side in sparsity.get_triplet())
    places: list[int] = (rows + columns * sparsity.size1()).tolist()
    return places
