"""Matrices that are the same at every iterate, those of a quadratic program, are evaluated once in a solve."""

import ctypes

import casadi as ca
import numpy as np
import pytest

from kpirl_ocp import OCP, Riccati, Status
from kpirl_ocp.ocp.interior_point import core as cores
from kpirl_ocp.ocp.interior_point import library as c
from kpirl_ocp.ocp.interior_point.core import Core
from kpirl_ocp.ocp.problem.solver import StageDerivatives

HORIZON = 6
EVALUATE = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p)


def statement(bend=0.0):
    """Weights, dynamics and a half-plane that depend on psi and the schedule; with `bend` the dynamics are curved."""
    s, u, psi, d = ca.SX.sym("s", 2), ca.SX.sym("u", 2), ca.SX.sym("psi", 2), ca.SX.sym("d")
    return OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        stage=d,
        schedule=np.linspace(0.5, 1.5, HORIZON + 1)[:, None],
        horizon=HORIZON,
        dynamics=s + 0.3 * d * u + psi[0] * ca.vertcat(s[1], bend * s[0] ** 2),
        stage_cost=ca.sumsqr(s - d) + psi[1] * ca.sumsqr(u) + 0.1 * s[0] * u[1],
        terminal_cost=3 * ca.sumsqr(s),
        action_bounds=(-1, 1),
        path_constraint=psi[1] * s[0] + u[0] - 3 * d,
        path_equality=u[0] - u[1] + 0.2 * s[0] * d,
        terminal_constraint=s[1] - psi[0],
    )


def options(tolerance=1e-10):
    return c.Options(max_iterations=100, tolerance=tolerance)


def solved(core, psi):
    (solution,) = core.solve(options(), False, np.array([[1.0, -0.5]]), np.array([psi]), np.zeros((1, 0)), [None])
    return solution


@pytest.fixture(params=["tapes", "virtual machine"])
def taped(request, monkeypatch):
    """Whether the core calls functions of the whole horizon, or those of a stage and of the end."""
    if request.param != "tapes":
        monkeypatch.setattr(cores, "read_tapes", lambda problem: None)
    return request.param == "tapes"


def counted(core):
    """The core's functions of second derivatives, with counts of their calls."""
    model, kept = core._model, []
    counts = {"stage": 0, "last": 0} if model.by_stage else {"horizon": 0}
    for name in counts:
        functions = getattr(model, name)
        own, self = EVALUATE(functions[2].evaluate), functions[2].self

        def evaluate(_, arguments, results, name=name, own=own, self=self):
            counts[name] += 1
            return own(self, arguments, results)

        kept.append(EVALUATE(evaluate))
        functions[2] = c.Function(ctypes.cast(kept[-1], ctypes.c_void_p), None)
    core.library.kpirl_mpc_core_set_model(core.address, ctypes.addressof(model))
    return counts, kept


def calls(taped, times):
    """What `counted` shows after matrices have been evaluated so many times."""
    return {"horizon": times} if taped else {"stage": times * HORIZON, "last": times}


def test_matrices_of_a_quadratic_program_are_evaluated_once_in_a_solve(taped):
    core = Core(statement())
    counts, _kept = counted(core)
    for solves in (1, 2, 3):
        solution = solved(core, [0.2, 0.5 * solves])
        assert solution.status is Status.CONVERGED
        assert solution.iterations > 2
        assert counts == calls(taped, solves)


def test_matrices_of_curved_dynamics_are_evaluated_at_every_iterate(taped):
    core = Core(statement(bend=0.1))
    counts, _kept = counted(core)
    solution = solved(core, [0.2, 0.5])
    assert solution.status is Status.CONVERGED
    assert counts == calls(taped, solution.iterations + 1)


@pytest.mark.parametrize("barrier", [0.0, 1e-2])
def test_plan_multipliers_and_derivatives_are_those_of_matrices_evaluated_at_every_iterate(monkeypatch, barrier):
    """To the last bit, for numbers that change from one solve to the next, cold and warm."""
    found = []
    for quadratic in (True, False):
        monkeypatch.setattr(cores, "quadratic_program", lambda _, quadratic=quadratic: quadratic)
        problem, solver, own = statement(), Riccati(1e-10, barrier=barrier, compile=False), []
        for psi in ([0.2, 0.5], [0.3, 2.0], [0.2, 0.5]):
            solution, derivatives = solver.solve_and_linearise(problem, [1.0, -0.5], psi)
            own += [solution, solver.solve(problem, [0.9, -0.5], psi, guess=solution)]
            assert own[-1].status is own[-2].status is Status.CONVERGED
            own.append(derivatives)
        found.append(own)
    for known, expected in zip(*found, strict=True):
        names = ("numbers",) if isinstance(known, StageDerivatives) else ("states", "actions")
        for name in names:
            np.testing.assert_array_equal(getattr(known, name), getattr(expected, name))
        if not isinstance(known, StageDerivatives):
            np.testing.assert_array_equal(known.multipliers.dynamics, expected.multipliers.dynamics)
            np.testing.assert_array_equal(known.multipliers.path, expected.multipliers.path)
