"""Steps along the dynamics: what they keep exactly, and problems that need them."""

from dataclasses import replace

import numpy as np
import pytest
from problems import TABLE, swing_up

from kpirl_ocp import KeypointCost, Riccati, Status, TimeDependent
from kpirl_ocp.assets import shipped_model
from kpirl_ocp.ocp.conditions.stage_derivatives import values
from kpirl_ocp.ocp.interior_point.feedback_rollout import follow
from kpirl_ocp.ocp.models.dynamics_files import load_dynamics
from kpirl_ocp.ocp.models.keypoint_problems import network_ocp


@pytest.fixture(name="given", params=["swing-up", "iiwa", "tanh network"])
def _given(request):
    case, rng = TABLE[request.param](), np.random.default_rng(0)
    problem, demonstration = case.problem, case.demonstration
    n_s, n_u, T = problem.n_states, problem.n_actions, problem.horizon
    S, dS = demonstration.s0[:, None] + 0.1 * rng.normal(size=(n_s, T + 1)), 0.1 * rng.normal(size=(n_s, T + 1))
    U, dU, K = 0.1 * rng.normal(size=(n_u, T)), 0.1 * rng.normal(size=(n_u, T)), 0.3 * rng.normal(size=(n_u, n_s * T))
    numbers = case.psi, demonstration.context
    return problem, (S, U, dS, dU, K, np.array(values(problem)(S, U, *numbers)[1])), numbers


@pytest.mark.parametrize("length", [0.0, 0.3, 1.0])
def test_defects_shrink_by_exactly_the_share_that_was_gone(given, length):
    problem, step, numbers = given
    states, actions, cost, _ = follow(problem)(*step, length, *numbers)
    expected, defects, _ = values(problem)(states, actions, *numbers)
    np.testing.assert_allclose(np.array(defects), (1 - length) * step[-1], rtol=0, atol=1e-13)
    np.testing.assert_allclose(float(cost), float(expected), rtol=1e-14)


def test_step_of_no_length_stays(given):
    problem, step, numbers = given
    states, actions, _, _ = follow(problem)(*step, 0.0, *numbers)
    np.testing.assert_allclose(np.array(states), step[0], rtol=0, atol=1e-13)
    np.testing.assert_allclose(np.array(actions), step[1], rtol=0, atol=1e-13)


def test_action_answers_to_the_state_with_the_gains(given):
    problem, (S, U, dS, dU, K, d), numbers = given
    states, actions, _, _ = map(np.array, follow(problem)(S, U, dS, dU, K, d, 1.0, *numbers))
    gains = K.reshape(problem.n_actions, problem.horizon, problem.n_states)
    feedback = np.einsum("uts,st->ut", gains, (states - S - dS)[:, :-1])
    np.testing.assert_allclose(actions, U + dU + feedback, rtol=0, atol=1e-13)


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
