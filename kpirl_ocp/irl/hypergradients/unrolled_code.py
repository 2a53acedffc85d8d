"""The functions of an unrolled gradient as machine code, compiled together where most of their code is common."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca

from kpirl_ocp.irl.hypergradients.affine_steps import has_affine_dynamics, has_quadratic_costs
from kpirl_ocp.irl.hypergradients.loss import Loss
from kpirl_ocp.irl.hypergradients.unrolled_graph import unrolled_function
from kpirl_ocp.irl.hypergradients.unrolled_slopes import losses_function
from kpirl_ocp.ocp.codegen.compiler import compile_all
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.solvers.gradient_descent import GradientDescent


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
