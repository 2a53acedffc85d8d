"""The functions of an unrolled gradient as machine code, compiled together where most of their code is common."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from kpirl_ocp.irl.hypergradients.affine_steps import has_affine_dynamics, has_quadratic_costs
from kpirl_ocp.irl.hypergradients.loss import Loss
from kpirl_ocp.irl.hypergradients.unrolled_graph import unrolled_function
from kpirl_ocp.irl.hypergradients.unrolled_slopes import Descent, losses_function, side_by_side
from kpirl_ocp.ocp.codegen.compiler import compile_all
from kpirl_ocp.ocp.codegen.numpy_calls import call_built
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.solvers.gradient_descent import GradientDescent
from kpirl_ocp.types import Array

_TOGETHER = 5  # descents in one call: products keep so many columns in registers, and records of more outgrow the cache


def columns_of(count: int) -> int:
    """The number of descents in one call, where there are `count`: about the same in all calls."""
    return math.ceil(count / math.ceil(count / _TOGETHER))


def outputs_of(descents: Sequence[Descent], last: int, checkpoint: bool) -> Array:
    """Outputs of `unrolled_function`, a row for each of the B descents; its last one fills up the last call."""
    first, columns = descents[0], columns_of(len(descents))
    evaluate = call_built(gradient_code, first.problem, first.solver, first.loss, last, checkpoint, columns)
    rows = []
    for begin in range(0, len(descents), columns):
        group = descents[begin : begin + columns]
        (outputs,) = evaluate(*side_by_side([*group, *[group[-1]] * (columns - len(group))]))
        rows.append(outputs.reshape(columns, -1)[: len(group)])
    return np.concatenate(rows)


def gradient_code(*what: Any) -> ca.Function:
    """`unrolled_function` of these arguments."""
    return _together(*what)[0]


def losses_code(problem: OCP, solver: GradientDescent, loss: Loss, *rest: Any) -> ca.Function:
    """`losses_function` for the steps to both sides of psi, beside a `gradient_code` of these arguments."""
    together = _together(problem, solver, loss, *rest)
    return together[-1] if len(together) > 1 else _losses_alone(problem, solver, loss)


@lru_cache(maxsize=64)
def _together(
    problem: OCP, solver: GradientDescent, loss: Loss, last: int, checkpoint: bool, columns: int
) -> list[ca.Function]:
    """The gradient, and the losses to both sides of psi if every gradient needs them."""
    functions = [unrolled_function(problem, solver, loss, last, checkpoint, columns)]
    if not (has_quadratic_costs(problem, loss) and has_affine_dynamics(problem, problem.derivatives is not None)):
        functions.append(losses_function(problem, solver, loss, columns=2))
    return compile_all(functions)


@lru_cache(maxsize=64)
def _losses_alone(problem: OCP, solver: GradientDescent, loss: Loss) -> ca.Function:
    return compile_all([losses_function(problem, solver, loss, columns=2)])[0]
