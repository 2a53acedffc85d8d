"""The stage functions of an exported controller, and how its parameters enter the conditions at a stage.

Dynamics that bring derivatives of their own (a network) reach the core for the whole horizon at once in Python. Here
they go stage by stage like all others: that takes a tenth of the memory, and the schedule stays an argument.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import TypeAlias

import casadi as ca

from kpirl_ocp.ocp.interior_point.stage_functions import (
    Levels,
    StageFunctions,
    last_functions,
    local_functions,
    stage_functions,
)
from kpirl_ocp.ocp.problem.linearised_dynamics import depends_on_psi
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.statement.expressions import inputs_of, kind_of

Symbols: TypeAlias = "Mapping[str, ca.MX | ca.SX]"


@lru_cache(maxsize=64)
def exported_stages(problem: OCP) -> StageFunctions:
    """Values, first and second derivatives of a stage and of the end."""
    if problem.derivatives is None:
        return stage_functions(problem)
    return StageFunctions(_arranged_stage(problem), last_functions(problem))


def _arranged_stage(problem: OCP) -> Levels:
    """A stage whose dynamics are differentiated by `OCP.derivatives`."""
    assert problem.derivatives is not None
    values, first, second = local_functions(problem)
    point = {name: values.mx_in(i) for i, name in enumerate(values.name_in())}
    multipliers = {name: first.mx_in(name) for name in ("z", "nu")}
    costates = ca.MX.sym("costates", problem.n_states)
    x, psi = point["x"], point["psi"] if depends_on_psi(problem.transition) else ca.MX(0, 1)
    dynamics = problem.derivatives.linearise(x[: problem.n_states], x[problem.n_states :], psi, costates)
    inputs = {**point, "costates": costates, **multipliers}
    function, prepared = dynamics.second()
    _, F, H = function.call(prepared, True, False)
    found = [_call(one, inputs) for one in (values, first, second)]
    for results in found:
        results["successor"] = dynamics.value
    found[1]["gradient"] += dynamics.Ft_lambda
    found[2]["gradient"] += F.T @ costates
    found[2] |= {"F": ca.densify(F), "H": ca.densify(H) + found[2]["H"]}
    return (
        _named("stage_values", point, found[0]),
        _named("stage_first", inputs, found[1]),
        _named("stage_second", inputs, found[2]),
    )


def _call(function: ca.Function, inputs: Symbols) -> dict[str, ca.MX]:
    results = function.call([inputs[name] for name in function.name_in()])
    return dict(zip(function.name_out(), results, strict=True))


def _named(name: str, inputs: Symbols, outputs: Symbols) -> ca.Function:
    return ca.Function(name, list(inputs.values()), list(outputs.values()), list(inputs), list(outputs))


@lru_cache(maxsize=64)
def pulls(problem: OCP) -> list[ca.Function]:
    """`stage_pull` and `last_pull`: derivatives by psi and the context of dx . grad L + dlambda . f + dz . h + dnu . e.

    L is the Lagrangian of a stage, or of the end, as in `stage_functions`, at x, psi, context, schedule and the
    multipliers; dx, dcostates, dz and dnu weigh the conditions.
    """
    stages = stage_functions(problem)
    return [_pull(f"{name}_pull", levels[0]) for name, levels in (("stage", stages.stage), ("last", stages.last))]


_CONDITIONS = {"successor": "costates", "path": "z", "equality": "nu"}


def _pull(name: str, values: ca.Function) -> ca.Function:
    """values: of a stage or of the end."""
    inputs, kind = dict(zip(values.name_in(), inputs_of(values), strict=True)), kind_of(values)
    found = dict(zip(values.name_out(), values.call(list(inputs.values()), True, False), strict=True))
    x, lagrangian, total = inputs["x"], found["cost"], kind(0)
    weights = {"dx": kind.sym("dx", x.numel())}
    for result, multiplier in _CONDITIONS.items():
        if result in found:
            inputs[multiplier] = kind.sym(multiplier, found[result].numel())
            weights[f"d{multiplier}"] = kind.sym(f"d{multiplier}", found[result].numel())
            lagrangian += ca.dot(inputs[multiplier], found[result])
            total += ca.dot(weights[f"d{multiplier}"], found[result])
    total += ca.jtimes(lagrangian, x, weights["dx"])
    outputs = {f"by_{one}": ca.densify(ca.gradient(total, inputs[one])) for one in ("psi", "context")}
    return _named(name, {**inputs, **weights}, outputs)
