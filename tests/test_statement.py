"""Whatever can be stated, against an independent statement of the same problem in CasADi's Opti."""

import pickle
from functools import lru_cache

import numpy as np
import pytest
from statements import CASES, optimum

from kpirl_ocp import SQP, Fatrop, Ipopt, Riccati, Status
from kpirl_ocp.ocp.conditions.audit import audit

case_of = lru_cache(lambda name: CASES[name]())
# Solver, tolerance on the objective and, ten times that, on the plan. Fatrop moves bounds outwards by 1e-8, and gives
# up on soft constraints at a residual of 1e-7.
ROWS = [(name, solver, 1e-8) for name in CASES for solver in (Riccati(), Ipopt(), SQP())]
ROWS += [(name, Fatrop(1e-6 if name == "soft constraints" else 1e-8), 1e-5) for name in CASES]


@pytest.mark.parametrize(("name", "solver", "atol"), ROWS, ids=str)
def test_solution_is_that_of_an_independent_statement(name, solver, atol):
    problem, arguments, _ = case_of(name)
    objective, states, actions = optimum(case_of(name))
    found = solver.solve(problem, *arguments)
    assert found.status is Status.CONVERGED
    np.testing.assert_allclose(found.objective, objective, rtol=0, atol=atol)
    np.testing.assert_allclose(problem.stated(found).states, states, rtol=0, atol=10 * atol)
    np.testing.assert_allclose(problem.stated(found).actions, actions, rtol=0, atol=10 * atol)


@pytest.mark.parametrize("name", CASES)
def test_a_problem_is_pickled_before_and_after_use(name):
    problem, arguments, _ = CASES[name]()
    before = pickle.loads(pickle.dumps(problem))
    found = Ipopt().solve(problem, *arguments)
    for copy in (before, pickle.loads(pickle.dumps(problem))):
        np.testing.assert_array_equal(Ipopt().solve(copy, *arguments).states, found.states)


@pytest.mark.parametrize("name", CASES)
def test_a_solution_is_a_guess_from_which_nothing_moves(name):
    problem, arguments, _ = case_of(name)
    found = Ipopt().solve(problem, *arguments)
    again = Ipopt().solve(problem, *arguments, guess=found)
    assert again.status is Status.CONVERGED
    assert again.iterations <= 5
    np.testing.assert_allclose(again.states, found.states, rtol=0, atol=1e-8)
    psi, context = problem.inputs(*arguments, *[()] * (3 - len(arguments)))[1:]
    assert audit(problem, psi, context, found.trajectory, found.multipliers).worst <= 1e-10
