"""What the report says about learned weights: keypoints that never move, averages over time, convergence."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))

pytest.importorskip("torch")
pytest.importorskip("cv2")

from reproduction.background import with_background, with_static_keypoint
from reproduction.checklist import ROWS, Row, verdict
from reproduction.identification import averages, identified, weight_slopes
from reproduction.outcome import Claim, settled

from kpirl_ocp import Descent
from kpirl_ocp.irl.visual.learning import COSTS, InnerLoop, learn_implicit, learn_unrolled
from kpirl_ocp.ocp.models import MLP, RBF, KeypointCost, NetworkDynamics
from kpirl_ocp.types import Demonstration

pytestmark = pytest.mark.usefixtures("virtual_machine")

T, K, N_Q = 10, 2, 3
A = np.array([[0.5, 0.0, 0.1], [0.0, 0.4, 0.1], [0.5, 0.0, -0.1], [0.0, 0.4, -0.1]])
INNER = InnerLoop(1, 2e-2)


@pytest.fixture(scope="module")
def dynamics():
    """Two keypoints that move by A u."""
    layers = [np.hstack([np.zeros((2 * K, 2 * K + 2 * N_Q)), A])], [np.zeros(2 * K)]
    return NetworkDynamics(MLP.from_layers(*layers), 2 * K, N_Q)


@pytest.fixture(scope="module")
def demonstration(dynamics):
    start, way = np.array([-0.3, -0.1, -0.2, 0.0]), np.array([0.4, 0.2, 0.4, 0.2])
    seen = start + np.linspace(0, 1, T + 1)[:, None] * way
    return Demonstration(dynamics.state(start, np.zeros(N_Q)), seen[-1], seen)


@pytest.mark.parametrize("start", [None, 0.01])
@pytest.mark.parametrize("cost", list(COSTS))
def test_a_keypoint_that_no_action_moves_keeps_its_starting_weight_exactly(cost, start, dynamics, demonstration):
    still, seen = with_static_keypoint(dynamics), with_background(demonstration, np.random.default_rng(0))
    runs = [
        learn_unrolled(still, [seen], COSTS[cost], INNER, n, np.random.default_rng(1), Descent(0.1), start=start)
        for n in (1, 500)
    ]
    before, after = (run.psi.reshape(-1, 2 * K + 2) for run in runs)
    np.testing.assert_array_equal(after[:, -2:], before[:, -2:])
    assert (after[:, :-2] != before[:, :-2]).any()
    found = identified(still, [seen], runs[1], INNER)
    assert not found["determined"][:, -2:].any()
    assert found["determined"][0, :-2].any()
    np.testing.assert_array_equal(found["gains"][-2:], 0.0)
    assert (found["axis_halfwidths"] < found["halfwidths"][0].reshape(-1, 2).max(axis=0)).all()


def test_a_static_keypoint_leaves_the_others_as_they_are(dynamics):
    still = with_static_keypoint(dynamics)
    z, theta, u = np.array([-0.3, -0.1, -0.2, 0.0]), np.zeros(N_Q), np.array([0.1, -0.2, 0.3])
    one = np.array(dynamics.function(0)(dynamics.state(z, theta), u, [])).ravel()
    other = np.array(still.function(0)(still.state(np.append(z, [0.7, -0.7]), theta), u, [])).ravel()
    np.testing.assert_allclose(np.delete(other, [4, 5]), one, atol=1e-15)
    np.testing.assert_array_equal(other[4:6], [0.7, -0.7])


def test_averages_of_psi_are_averages_of_the_weights():
    basis, psi = RBF(3).matrix(T), np.random.default_rng(0).normal(size=12)
    weights, _ = KeypointCost(RBF(3)).weights(psi, T, 4)
    expected = [weights.mean(axis=0), weights[:5].mean(axis=0), weights[-5:].mean(axis=0)]
    np.testing.assert_allclose(averages(basis, 4) @ psi, np.concatenate(expected), rtol=1e-12)


def test_slopes_of_positive_weights_are_those_of_differences():
    psi = np.array([-2.0, 0.1, 3.0])
    family = KeypointCost(COSTS["Weighted"], positivity="softplus")
    ends = [family.weights(psi + h, 1, 3)[0][0] for h in (1e-6, -1e-6)]
    np.testing.assert_allclose(weight_slopes("softplus", psi), (ends[0] - ends[1]) / 2e-6, rtol=1e-8)


def test_the_converged_problem_is_identified_with_its_own_derivative(dynamics, demonstration):
    learned = learn_implicit(
        dynamics, [demonstration], COSTS["Weighted"], InnerLoop(5, 2e-2), 5, np.random.default_rng(0)
    )
    found = identified(dynamics, [demonstration], learned, InnerLoop(5, 2e-2))
    assert found["uncertified"] == 0
    assert 0 < found["known"] <= found["parameters"] == 4
    assert (found["halfwidths"] > 0).all()


def test_a_loss_has_settled_where_the_rest_of_its_descent_is_small():
    losses = 1.0 + 99.0 * 0.5 ** np.arange(40.0)
    assert settled(losses) == 5  # 1/32 of the descent is left
    assert settled(np.array([3.0, 5.0, 1.0, 4.0])) == 2


def test_every_row_of_the_checklist_has_a_verdict_or_claims_that_decide():
    assert all(bool(row.verdict) != bool(row.claims) for row in ROWS)
    assert len(ROWS) > 25
    found = [Claim("Placing: a", True, "1"), Claim("Placing: b", False, "2"), Claim("Reaching: c", True, "3")]
    assert verdict(Row("1", "x", claims=("Reaching",)), found) == "same: 1 of 1 tests hold"
    assert verdict(Row("1", "x", claims=("Placing",)), found) == "differs: 1 of 2 tests hold; not 'Placing: b' (2)"
    assert verdict(Row("1", "x", claims=("Nothing",)), found) == "not tested in this run"
