"""Planning and learning with a network: the passes along a trajectory, and the gradients that are built from them."""

from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from problems import pendulum
from scipy.optimize import brentq

from kpirl_ocp import (
    Adam,
    Demonstration,
    FiniteDifference,
    GradientDescent,
    Implicit,
    Ipopt,
    Trajectory,
    Truncated,
    Unrolled,
    learn,
)
from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.hypergradients import unrolled_code
from kpirl_ocp.irl.hypergradients.loss import squared_distance
from kpirl_ocp.irl.hypergradients.unrolled_graph import unrolled_function
from kpirl_ocp.irl.learning.learn import Learner
from kpirl_ocp.ocp.codegen import compiler as native
from kpirl_ocp.ocp.models import RBF, KeypointCost, TimeDependent, Weighted
from kpirl_ocp.ocp.models.keypoint_dynamics import NetworkDynamics
from kpirl_ocp.ocp.models.keypoint_passes import NetworkPasses
from kpirl_ocp.ocp.models.keypoint_problems import network_ocp
from kpirl_ocp.ocp.models.mlp import MLP
from kpirl_ocp.ocp.problem.reduced_cost import ReducedCost
from kpirl_ocp.ocp.problem.trajectory_passes import StagePasses

HORIZON, STEPS = 5, 4
KERNELS = RBF(3)
pytestmark = pytest.mark.usefixtures("virtual_machine")


def dynamics(activation="tanh", residual=True, seed=0):
    rng, widths = np.random.default_rng(seed), (4 + 3 * 2, 12, 7, 4)
    weights = [rng.normal(size=(m, n)) / np.sqrt(n) for n, m in pairwise(widths)]
    mlp = MLP.from_layers(weights, [0.3 * rng.normal(size=m) for m in widths[1:]], activation)
    return NetworkDynamics(mlp, n_z=4, n_joints=2, residual=residual)


@lru_cache
def network_problem(activation="tanh", effort=0.0, basis=KERNELS):
    return network_ocp(dynamics(activation), KeypointCost(basis, effort=effort), HORIZON)


def demonstrations(problem, count=1):
    rng, found = np.random.default_rng(1), []
    for _ in range(count):
        s0 = dynamics().state(rng.uniform(-1, 1, 4), rng.uniform(-1, 1, 2), rng.uniform(-0.3, 0.3, 2))
        seen = problem.simulate(s0, 0.2 * rng.normal(size=(HORIZON, 2)), np.zeros(problem.n_parameters)).states[:, :4]
        found.append(Demonstration(s0, seen[-1], seen))
    return found


def psi_of(problem):
    return np.random.default_rng(2).uniform(0.5, 1.5, problem.n_parameters)


def by_ad(problem):
    """The same problem without the derivatives arranged by hand."""
    return replace(problem, derivatives=None)


def error(found, expected):
    return float(np.abs(found - expected).max() / np.abs(expected).max())


# Passes along trajectories


def results(passes, n_psi, horizon, columns):
    """All results of the four passes, as one function of random arrays."""
    s0, psi, U, dU, Q, dQ = (
        ca.MX.sym(name, rows, width * columns)
        for name, rows, width in [
            ("s0", 8, 1),
            ("psi", n_psi, 1),
            ("U", 2, horizon),
            ("dU", 2, horizon),
            ("Q", 8, horizon + 1),
            ("dQ", 8, horizon + 1),
        ]
    )
    at = passes.rollout(s0, U, psi)
    dS = passes.tangent(at, psi, dU)
    first = passes.adjoint(at, psi, Q)
    second = passes.adjoint_tangent(at, psi, first.memory, dS, dU, dQ)
    return ca.Function("passes", [s0, psi, U, dU, Q, dQ], [at.states, dS.states, *first[:3], *second[:3]])


@pytest.mark.parametrize("columns", [1, 3, 4])
@pytest.mark.parametrize("horizon", [1, 4])
@pytest.mark.parametrize(("activation", "residual"), [("relu", True), ("tanh", True), ("silu", False)])
def test_passes_of_a_network_are_those_stage_by_stage(activation, residual, horizon, columns):
    model = dynamics(activation, residual)
    function = model.function(3)
    fast = results(NetworkPasses(model, horizon, columns), 3, horizon, columns)
    slow = results(StagePasses(function, horizon, columns), 3, horizon, columns)
    rng = np.random.default_rng(3)
    point = [rng.normal(size=fast.size_in(i)) for i in range(fast.n_in())]
    for found, expected in zip(fast(*point), slow(*point), strict=True):
        np.testing.assert_allclose(np.array(found), np.array(expected), rtol=0, atol=5e-14)


@pytest.mark.parametrize("name", ["network", "pendulum"])
def test_gradient_and_hessian_product_of_the_reduced_cost_are_those_of_ad(name):
    problem = network_problem() if name == "network" else pendulum().problem
    rng, reduced = np.random.default_rng(4), ReducedCost(problem)
    s0, psi, c = (ca.MX.sym("x", n) for n in (problem.n_states, problem.n_parameters, problem.n_context))
    U, dU = (ca.MX.sym("U", problem.n_actions, problem.horizon) for _ in range(2))
    theta = reduced.cost.coefficients(psi, c)
    at = reduced.linearise(s0, U, psi, theta)
    product = reduced.hessian_product(at.rollout, at.adjoint.memory, psi, theta, dU)
    value = problem.cost(problem.rollout(s0, U, psi, c), U, psi, c)
    slope = ca.gradient(value, U)
    expected = [value, slope, ca.gradient(ca.dot(slope, dU), U)]
    both = ca.Function("both", [s0, psi, c, U, dU], [at.value, at.gradient, product.by_actions, *expected])
    point = [rng.uniform(0.5, 1.0, size=both.size_in(i)) for i in range(5)]
    values = [np.array(value) for value in both(*point)]
    for found, wanted in zip(values[:3], values[3:], strict=True):
        assert error(found, wanted) <= 1e-13


# Gradients


@pytest.mark.parametrize("activation", ["relu", "tanh", "softplus", "leaky_relu"])
@pytest.mark.parametrize("basis", [Weighted(), TimeDependent(), RBF(3)], ids=str)
def test_unrolled_gradient_with_a_network_is_that_of_ad_and_of_finite_differences(activation, basis):
    problem = network_problem(activation, basis=basis)
    (demonstration,), psi, solver = demonstrations(problem), psi_of(problem), GradientDescent(STEPS, 0.02)
    found = Unrolled(solver)(problem, demonstration, psi)
    stage_by_stage = Unrolled(solver)(by_ad(problem), demonstration, psi)
    differences = FiniteDifference(solver)(problem, demonstration, psi)
    assert error(found.gradient, stage_by_stage.gradient) <= 1e-12
    assert error(found.gradient, differences.gradient) <= 1e-8
    assert found.loss == pytest.approx(differences.loss, rel=1e-13)
    assert found.certificate.certified


@pytest.mark.skipif(native.compiler() is None, reason="there is no C compiler")
@pytest.mark.parametrize("activation", ["relu", "silu"])
def test_compiled_gradient_is_that_of_the_virtual_machine(activation, monkeypatch):
    slow = network_problem(activation)
    (demonstration,), psi, method = demonstrations(slow), psi_of(slow), Unrolled(GradientDescent(STEPS, 0.02))
    expected = method(slow, demonstration, psi)
    monkeypatch.setattr(unrolled_code, "compile_all", native.compile_all)
    found = method(replace(slow), demonstration, psi)
    assert found.loss == pytest.approx(expected.loss, rel=1e-13)
    assert error(found.gradient, expected.gradient) <= 1e-12


@pytest.mark.parametrize(("name", "count"), [("network", 5), ("network", 7), ("pendulum", 2)])
def test_several_demonstrations_together_give_what_each_gives_alone(name, count):
    problem = network_problem() if name == "network" else replace(pendulum().problem)
    found = demonstrations(problem, count) if name == "network" else [pendulum().demonstration] * count
    psi, method = psi_of(problem), Unrolled(GradientDescent(STEPS, 0.02))
    assert method.batch(problem, [], psi) == []
    for one, alone in zip(method.batch(problem, found, psi), (method(problem, d, psi) for d in found), strict=True):
        assert one.loss == pytest.approx(alone.loss, rel=1e-14)
        assert error(one.gradient, alone.gradient) <= 1e-12
        np.testing.assert_allclose(one.certificate.solution.states, alone.certificate.solution.states, atol=1e-13)
        np.testing.assert_allclose(
            one.certificate.solution.multipliers.dynamics, alone.certificate.solution.multipliers.dynamics, atol=1e-12
        )
        assert one.certificate.certified


def test_projected_demonstrations_together_keep_their_own_kink_distance():
    problem = replace(network_problem(), action_bounds=(-0.02, 0.02))
    found, psi = demonstrations(problem, 3), psi_of(problem)
    method = Unrolled(GradientDescent(STEPS, 0.02, project=True))
    together = [result.certificate for result in method.batch(problem, found, psi)]
    alone = [method(problem, demonstration, psi).certificate for demonstration in found]
    distances = [certificate.kink_distance for certificate in together]
    np.testing.assert_allclose(distances, [certificate.kink_distance for certificate in alone], rtol=1e-10)
    assert len(set(distances)) == 3
    assert (np.abs(together[0].solution.actions) <= 0.02).all()
    assert (np.abs(together[0].solution.actions) == 0.02).any()


@pytest.mark.parametrize("steps", [1, 7, 40])
def test_checkpoints_change_the_memory_and_not_the_gradient(steps):
    problem = network_problem()
    (demonstration,), psi, solver = demonstrations(problem), psi_of(problem), GradientDescent(steps, 0.02)
    plain, saving = (Unrolled(solver, checkpoint=flag)(problem, demonstration, psi) for flag in (False, True))
    np.testing.assert_array_equal(saving.gradient, plain.gradient)
    assert saving.loss == plain.loss
    truncated = Truncated(solver, steps)(problem, demonstration, psi)
    np.testing.assert_array_equal(truncated.gradient, plain.gradient)


def test_memory_with_checkpoints_grows_like_the_square_root_of_the_steps():
    problem = network_problem()

    def work(steps, checkpoint):
        solver = GradientDescent(steps, 0.02)
        return unrolled_function(problem, solver, squared_distance, steps, checkpoint, columns=1).sz_w()

    assert work(1600, checkpoint=True) < 2 * work(400, checkpoint=True)
    assert work(1600, checkpoint=True) < 0.2 * work(1600, checkpoint=False)


def test_implicit_gradient_with_a_smooth_network_is_that_of_finite_differences():
    problem = network_problem("tanh", effort=1.0)
    (demonstration,), psi = demonstrations(problem), psi_of(problem)
    found = Implicit(Ipopt(1e-12))(problem, demonstration, psi)
    expected = FiniteDifference(Ipopt(1e-12))(problem, demonstration, psi)
    assert error(found.gradient, expected.gradient) <= 1e-8
    assert found.certificate.certified


def test_learning_takes_the_mean_over_demonstrations_evaluated_together():
    problem = network_problem()
    found, psi, method = demonstrations(problem, 3), psi_of(problem), Unrolled(GradientDescent(STEPS, 0.02))
    point = Learner(problem, found, method, Adam()).evaluate(psi)
    alone = [method(problem, demonstration, psi) for demonstration in found]
    assert point.loss == pytest.approx(np.mean([result.loss for result in alone]), rel=1e-13)
    assert error(point.gradient, np.mean([result.gradient for result in alone], axis=0)) <= 1e-12
    result = learn(problem, found, psi, method, steps=5, progress=False)
    assert result.loss < result.losses[0]


def test_slopes_to_both_sides_are_taken_only_where_an_iterate_comes_near_a_kink_of_the_network():
    """Two steps from a start chosen so that the first leads onto the kink of a ReLU; and from one beside it."""
    problem, mlp = network_problem("relu"), dynamics("relu").mlp
    (demonstration,), psi = demonstrations(problem), psi_of(problem)
    s0, context = demonstration.s0, demonstration.context

    def start(first):
        return Trajectory(np.zeros(0), np.full((HORIZON, 2), [first, 0.1]))

    def argument(first):
        """Of the third ReLU at the first stage, after one step."""
        actions = GradientDescent(1, 0.2).solve(problem, s0, psi, context, start(first)).actions
        return (mlp.weights[0] @ np.concatenate([s0, actions[0]]) + mlp.biases[0])[2]

    kink, method = brentq(argument, -20, 20, xtol=1e-15), Unrolled(GradientDescent(2, 0.2), policy="flag")
    at, beside = (method(problem, demonstration, psi, start(kink + distance)) for distance in (0, 1e-3))
    assert "end on a kink or cross one" in str(at.certificate)
    assert beside.certificate.certified
    assert beside.certificate.kink == 0
    measured = method(by_ad(problem), demonstration, psi, start(kink + 1e-3))
    assert 0 < measured.certificate.kink < 1e-4
    assert measured.certificate.certified
    assert error(beside.gradient, measured.gradient) <= 1e-12


def test_a_network_that_yields_nan_is_not_certified():
    model = dynamics("relu")
    huge = replace(model, mlp=MLP.from_layers([1e200 * w for w in model.mlp.weights], model.mlp.biases))
    problem = network_ocp(huge, KeypointCost(Weighted()), HORIZON)
    demonstration = Demonstration(model.state(np.ones(4), np.ones(2)), np.zeros(4), np.zeros((HORIZON + 1, 4)))
    result = Unrolled(GradientDescent(STEPS, 0.02), policy="flag")(problem, demonstration, np.ones(4))
    assert "NaN or infinite" in str(result.certificate)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"joint_limits": (1.0, -1.0)}, "joint_limits must be numbers: no lower bound above"),
        ({"joint_limits": ([0.0] * 3, [1.0] * 3)}, r"joint_limits must be \(lower, upper\), each a number or \(2,\)"),
        ({"max_displacement": 0.0}, "max_displacement must be positive"),
    ],
)
def test_bounds_that_make_no_sense_are_refused(options, reason):
    with pytest.raises(ProblemError, match=reason):
        network_ocp(dynamics(), KeypointCost(Weighted()), HORIZON, **options)


def test_limits_bound_the_joints_and_not_the_keypoints():
    problem = network_ocp(
        dynamics(), KeypointCost(Weighted()), HORIZON, joint_limits=(-1.0, [1.0, 2.0]), max_displacement=0.1
    )
    infinite = [np.inf] * 4
    np.testing.assert_array_equal(problem.state_bounds[1][-1], [*infinite, 1.0, 2.0, np.inf, np.inf])
    np.testing.assert_array_equal(np.array(problem.action_bounds)[:, 0], [[-0.1] * 2, [0.1] * 2])
