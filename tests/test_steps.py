"""Problems whose linearisation holds only nearby, and what holds along the way to a solution."""

from dataclasses import replace

import numpy as np
import pytest
from problems import swing_up

from kpirl_ocp import Riccati, Status
from kpirl_ocp.assets import shipped_model
from kpirl_ocp.ocp.models import KeypointCost, TimeDependent
from kpirl_ocp.ocp.models.dynamics_files import load_dynamics
from kpirl_ocp.ocp.models.keypoint_problems import network_ocp


@pytest.mark.parametrize("seed", range(4))
def test_minimum_is_found_with_a_trained_model_whose_linearisation_holds_only_nearby(seed):
    """Costates reach 1e6 here, and steps along the linearisation become short until nothing is accepted."""
    rng, dynamics, horizon = np.random.default_rng(seed), load_dynamics(shipped_model("placing")), 10
    cost = KeypointCost(TimeDependent(), effort=1.0)
    problem = network_ocp(dynamics, cost, horizon)
    start = dynamics.state(0.3 * rng.uniform(-1, 1, 8), [0.0, 1.0, 0.0, -1.2, 0.0, 0.8, 0.0])
    goal = start[:8] + 0.2 * rng.uniform(-1, 1, 8)
    psi = 10 ** rng.uniform(0, 3, horizon * 8)
    found = Riccati().solve(problem, start, psi, goal)
    assert found.status is Status.CONVERGED
    unmoved = problem.cost(problem.simulate(start, 0 * found.actions, psi).states.T, 0 * found.actions.T, psi, goal)
    assert found.objective < 0.5 * float(unmoved)


def test_bounds_hold_strictly_along_the_way():
    case = swing_up()
    for iterations in range(1, 12):
        found = Riccati(max_iterations=iterations).solve(
            case.problem, case.demonstration.s0, case.psi, case.demonstration.context
        )
        assert (np.abs(found.actions) < 5).all()
        assert (np.abs(found.states[1:, 1]) < 6).all()


def test_a_large_objective_needs_no_other_settings():
    case = swing_up()
    psi = np.array([0.8, 1e4])
    found = Riccati().solve(case.problem, case.demonstration.s0, psi, case.demonstration.context)
    assert found.status is Status.CONVERGED
    again = replace(Riccati(), tolerance=1e-12).solve(
        case.problem, case.demonstration.s0, psi, case.demonstration.context, guess=found
    )
    np.testing.assert_allclose(again.actions, found.actions, rtol=0, atol=1e-6)
