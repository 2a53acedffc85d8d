"""Unrolled gradients of problems with a network: steep ones are searched, gentle ones need not be."""

from functools import partial

import casadi as ca
import numpy as np
import pytest

from kpirl_ocp import OCP, Demonstration, GradientDescent, Unrolled
from kpirl_ocp.irl.hypergradients import unrolled
from kpirl_ocp.irl.hypergradients.smoothness import parameter_kinks
from kpirl_ocp.ocp.models.keypoint_dynamics import LinearisedNetwork, NetworkDynamics
from kpirl_ocp.ocp.models.keypoint_passes import NetworkPasses
from kpirl_ocp.ocp.models.mlp import MLP
from kpirl_ocp.ocp.problem import DynamicsDerivatives

pytestmark = pytest.mark.usefixtures("virtual_machine")

CURVED = ("elu", "sigmoid", "silu", "softplus", "tanh")


def problem_of(mlp, target):
    """One keypoint and one joint; the actions follow the target, an expression of psi."""
    model, psi = NetworkDynamics(mlp, 1, 1), ca.SX.sym("psi")
    s, u, nothing = ca.SX.sym("s", 3), ca.SX.sym("u"), ca.SX.sym("none", 0)
    rest = [s, psi, nothing, nothing]
    return OCP(
        dynamics=model.function(1),
        stage_cost=ca.Function("stage", [s, u, psi, nothing, nothing], [0.5 * (u - target(psi)) ** 2]),
        terminal_cost=ca.Function("terminal", rest, [0 * s[0]]),
        observation=ca.Function("observation", [s], [s[0]]),
        horizon=2,
        derivatives=DynamicsDerivatives(partial(LinearisedNetwork, model), partial(NetworkPasses, model)),
    )


def step_at(place, steepness, activation):
    """0.3 sigma(k (theta + u - place)) and its mirror image, as a network of (z, theta, theta_dot, u)."""
    first = steepness * np.array([[0.0, 1.0, 0.0, 1.0], [0.0, -1.0, 0.0, -1.0]])
    biases = steepness * np.array([-place, place])
    return MLP.from_layers([first, [[0.3, -0.1]]], [biases, [0.0]], activation)


def gradient_at(problem, psi):
    seen = Demonstration(np.zeros(3), np.zeros(0), np.array([[0.0], [0.5], [1.0]]))
    return Unrolled(GradientDescent(8, 0.99), policy="flag")(problem, seen, [psi])


@pytest.mark.parametrize("activation", CURVED)
@pytest.mark.parametrize(("steepness", "certified"), [(1e2, True), (1e7, False)])
def test_a_network_as_steep_as_a_step_is_flagged_and_a_gentle_one_is_certified(activation, steepness, certified):
    problem = problem_of(step_at(0.3, steepness, activation), lambda psi: psi)
    found = gradient_at(problem, 0.3 + 0.5 / steepness)
    assert found.certificate.certified is certified


@pytest.mark.parametrize("activation", CURVED)
def test_gradients_of_gentle_networks_are_those_that_steps_beside_confirm(activation, monkeypatch):
    problem = problem_of(step_at(0.3, 3.0, activation), lambda psi: psi)
    proved = gradient_at(problem, 0.7)
    monkeypatch.setattr(unrolled, "_STEADY", -1.0)
    searched = gradient_at(problem, 0.7)
    assert proved.certificate.kink == 0 < searched.certificate.kink < 1e-5
    assert proved.certificate.certified
    assert searched.certificate.certified
    np.testing.assert_allclose(proved.gradient, searched.gradient, rtol=1e-14)


@pytest.mark.parametrize("activation", ["relu", "tanh"])
def test_a_step_is_found_where_a_small_action_is_what_is_left_of_large_parameters(activation):
    """u = psi - 1: a millionth of psi is a thousandth of u."""
    problem = problem_of(step_at(1e-3, 1e7, activation), lambda psi: psi - 1)
    found = gradient_at(problem, 1 + 1e-3 + 1e-9)
    assert not found.certificate.certified


@pytest.mark.parametrize(("gap", "certified"), [(1e-9, False), (1e-7, False), (1e-4, True)])
def test_a_kink_of_a_network_is_found_however_large_its_weights(gap, certified):
    problem = problem_of(step_at(0.3, 1e6, "relu"), lambda psi: psi)
    assert gradient_at(problem, 0.3 + gap).certificate.certified is certified


def test_a_kink_beside_one_of_several_demonstrations_leaves_the_proofs_of_the_others():
    problem, method = (
        problem_of(step_at(0.3, 1e6, "relu"), lambda psi: psi),
        Unrolled(GradientDescent(8, 0.99), policy="flag"),
    )
    starts = [np.array([0.0, theta, 0.0]) for theta in (1.0, 0.0, -2.0, 3.0, 2.0)]
    seen = [Demonstration(start, np.zeros(0), np.array([[0.0], [0.5], [1.0]])) for start in starts]
    together = [result.certificate for result in method.batch(problem, seen, [0.3 + 1e-9])]
    alone = [method(problem, demonstration, [0.3 + 1e-9]).certificate for demonstration in seen]
    assert [certificate.certified for certificate in together] == [True, False, True, True, True]
    assert [certificate.kink == 0 for certificate in together] == [True, False, True, True, True]
    assert [str(certificate) for certificate in together] == [str(certificate) for certificate in alone]


@pytest.mark.parametrize(("target", "searched"), [(lambda psi: psi, False), (ca.fabs, True)])
def test_beside_a_kink_of_the_network_costs_are_searched_for_kinks_in_psi_unless_they_are_quadratic(
    target, searched, monkeypatch
):
    found = []
    monkeypatch.setattr(unrolled, "parameter_kinks", lambda *at: found.append(parameter_kinks(*at)) or [])
    problem = problem_of(step_at(0.3, 1e6, "relu"), target)
    certificate = gradient_at(problem, 0.3 + 1e-9).certificate
    assert not certificate.certified
    assert bool(found) is searched
    assert parameter_kinks(problem, certificate.solution) == []
