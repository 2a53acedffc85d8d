"""Functions of stages as tapes of operations have the results of CasADi's virtual machine, to the last bit."""

import ctypes
from dataclasses import replace
from itertools import product

import casadi as ca
import numpy as np
import pytest

from kpirl_ocp import OCP, Riccati
from kpirl_ocp.ocp.interior_point import core as core_module
from kpirl_ocp.ocp.interior_point.core import dimensions_of
from kpirl_ocp.ocp.interior_point.library import HORIZON, address_of, library
from kpirl_ocp.ocp.interior_point.stage_functions import stage_functions
from kpirl_ocp.ocp.interior_point.tapes import Tapes, read_tapes

VALUES = (-np.inf, -7e300, -2.5, -1.0, -0.0, 0.0, 5e-324, 0.3, 1.0, 3.0, np.inf, np.nan)
BINARY = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "pow": lambda a, b: a**b,
    "constpow": lambda a, b: a**2.7 + b**5,
    "fmod": ca.fmod,
    "remainder": ca.remainder,
    "atan2": ca.atan2,
    "hypot": ca.hypot,
    "copysign": ca.copysign,
    "fmin": ca.fmin,
    "fmax": ca.fmax,
    "lt": ca.lt,
    "le": ca.le,
    "eq": ca.eq,
    "ne": ca.ne,
    "and": ca.logic_and,
    "or": ca.logic_or,
    "if_else": lambda a, b: ca.if_else(a > 0.2, b, 3 * a),
}
UNARY = {
    "neg": lambda a: -a,
    "inv": lambda a: 1 / a,
    "sq": lambda a: a**2,
    "twice": lambda a: 2 * a,
    "not": ca.logic_not,
    **{
        name: getattr(ca, name)
        for name in (
            *("sqrt", "sign", "fabs", "floor", "ceil", "exp", "expm1", "log", "log1p", "erf", "sin", "cos", "tan"),
            *("asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh"),
        )
    },
}
OPERATIONS = BINARY | {name: lambda a, b, of=of: ca.vertcat(of(a), of(b)) for name, of in UNARY.items()}


def played(problem, level, given):
    """Results by name of the tapes of a level; given: arguments by name."""
    tapes = Tapes(*read_tapes(problem)[level], dimensions_of(problem), np.ascontiguousarray(problem.schedule, float))
    T, n_s = problem.horizon, problem.n_states
    n_x, n_h, n_e = n_s + problem.n_actions, problem.n_path, problem.n_path_equality
    of_stages = {"successor": n_s, "path": n_h, "equality": n_e, "cost_gradient": n_x, "gradient": n_x}
    of_stages |= {"F": n_s * n_x, "G": n_x * n_h, "E": n_x * n_e, "H": n_x * n_x}
    n_h, n_e = problem.n_terminal, problem.n_terminal_equality
    of_end = {"path_last": n_h, "equality_last": n_e, "cost_gradient_last": n_s, "gradient_last": n_s}
    of_end |= {"G_last": n_s * n_h, "E_last": n_s * n_e, "H_last": n_s * n_s}
    found = {"cost": np.zeros(1)} | {name: np.zeros((T, size)) for name, size in of_stages.items()}
    found |= {name: np.zeros(size) for name, size in of_end.items()}
    pointers = [
        (ctypes.c_void_p * len(names))(*(address_of(arrays[name]) for name in names))
        for names, arrays in zip(HORIZON, (given, found), strict=True)
    ]
    play = library().kpirl_mpc_evaluate_tapes
    play.argtypes = [ctypes.c_void_p] * 3
    assert play(tapes.pointer.self, *map(ctypes.addressof, pointers)) == 0
    return found


def dense(function, inputs):
    """Results by name, as columns of dense numbers."""
    results = function.call([ca.DM(x) for x in inputs])
    return {name: np.array(ca.densify(x)).ravel("F") for name, x in zip(function.name_out(), results, strict=True)}


def same_bits(found, expected):
    return np.array_equal(np.isnan(found), np.isnan(expected)) and np.array_equal(
        np.nan_to_num(found, nan=0.0).view(np.int64), np.nan_to_num(expected, nan=0.0).view(np.int64)
    )


@pytest.mark.parametrize("name", OPERATIONS)
def test_an_operation_of_any_numbers_has_the_bits_of_the_virtual_machine(name):
    """But for the zero that fmin and fmax choose of two with different signs: C does not say which."""
    pairs = np.array([pair for pair in product(VALUES, VALUES) if name not in ("fmin", "fmax") or any(pair)])
    s = ca.SX.sym("s", 2)
    dynamics = ca.vertcat(OPERATIONS[name](s[0], s[1]), s[1])[:2]
    problem = OCP.from_expressions(state=s, horizon=len(pairs), dynamics=dynamics)
    given = dict.fromkeys(HORIZON[0], np.zeros(0))
    found = played(problem, 0, given | {"states": np.vstack([pairs, [[0, 0]]])})["successor"]
    values = stage_functions(problem).stage[0]
    for pair, successor in zip(pairs, found, strict=True):
        assert same_bits(successor, dense(values, [pair, [], [], []])["successor"]), pair


@pytest.mark.parametrize("horizon", [1, 15, 16, 37])
@pytest.mark.parametrize("level", [0, 1, 2])
def test_all_results_of_all_stages_have_the_bits_of_the_virtual_machine(horizon, level):
    s, u, psi, c, d = (ca.SX.sym(name, size) for name, size in (("s", 3), ("u", 2), ("psi", 2), ("c", 2), ("d", 1)))
    force = ca.vertcat(ca.sin(s[1]) * u[0], psi[0] * s[2] ** 2, ca.tanh(u[1]) + c[0] + d)
    rng = np.random.default_rng(horizon)
    problem = OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        context=c,
        stage=d,
        schedule=rng.normal(size=(horizon + 1, 1)),
        horizon=horizon,
        dynamics=s + 0.1 * force,
        stage_cost=psi[1] * ca.sumsqr(s * ca.exp(s[0])) + ca.sumsqr(u) * d,
        terminal_cost=ca.sumsqr(s - c[1]) * d,
        path_constraint=ca.vertcat(s[0] * u[0] - 1, u[1] - s[2]),
        path_equality=s[1] * s[0] - u[0] ** 3,
        terminal_constraint=s[0] * s[1] - c[1],
        terminal_equality=ca.sin(s[2]),
    )
    T = horizon
    shapes = dict(states=(T + 1, 3), actions=(T, 2), psi=2, context=2, costates=(T, 3))
    shapes |= dict(z=(T, 2), nu=(T, 1), z_last=1, nu_last=1)
    given = {name: rng.normal(size=shape) for name, shape in shapes.items()}
    found, functions, cost = played(problem, level, given), stage_functions(problem), 0.0
    for t in range(T):
        x, d_t = np.concatenate([given["states"][t], given["actions"][t]]), problem.schedule[t]
        duals = [given[name][t] for name in ("costates", "z", "nu")]
        inputs = [x, given["psi"], given["context"], d_t, *duals]
        expected = dense(functions.stage[level], inputs[: functions.stage[level].n_in()])
        cost += expected.pop("cost")[0]
        for name, value in expected.items():
            assert same_bits(found[name][t], value), (name, t)
    inputs = [
        given["states"][T],
        given["psi"],
        given["context"],
        problem.schedule[T],
        given["z_last"],
        given["nu_last"],
    ]
    expected = dense(functions.last[level], inputs[: functions.last[level].n_in()])
    assert found["cost"][0] == cost + expected.pop("cost")[0]
    for name, value in expected.items():
        assert same_bits(found[f"{name}_last"], value), name


def problem_in(kind, dynamics, cost=lambda s, u: ca.sumsqr(ca.sin(s) - 0.5) + 0.01 * ca.sumsqr(u)):
    s, u = kind.sym("s", 2), kind.sym("u", 2)
    return OCP.from_expressions(state=s, action=u, horizon=20, dynamics=dynamics(s, u), stage_cost=cost(s, u))


def test_solutions_are_the_same_with_the_virtual_machine_with_tapes_and_as_machine_code(monkeypatch):
    problem, used = problem_in(ca.SX, lambda s, u: s + 0.1 * u), []
    monkeypatch.setattr(core_module, "Tapes", lambda *given: used.append(given) or Tapes(*given))
    taped, compiled = (Riccati(compile=wish).solve(problem, [0.3, -1.0]) for wish in (False, True))
    assert len(used) == 3
    monkeypatch.setattr(core_module, "read_tapes", lambda problem: None)
    virtual = Riccati(compile=False).solve(replace(problem), [0.3, -1.0])
    assert len(used) == 3
    for other in (taped, compiled):
        assert other.objective == virtual.objective
        assert np.array_equal(other.states, virtual.states)
        assert np.array_equal(other.multipliers.dynamics, virtual.multipliers.dynamics)


def test_functions_of_matrices_and_rare_operations_stay_with_the_virtual_machine():
    assert read_tapes(problem_in(ca.SX, lambda s, u: s + ca.erfinv(u))) is None
    table = ca.interpolant("table", "linear", [[0.0, 1.0]], [0.0, 2.0])
    assert read_tapes(problem_in(ca.MX, lambda s, u: s + table(u[0]))) is None
