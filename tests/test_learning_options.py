"""Learning: starts and warm starts, horizons, losses, scales, bounds, checkpoints, callbacks and interruption."""

from dataclasses import replace
from functools import lru_cache, partial

import casadi as ca
import numpy as np
import pytest

from kpirl_ocp import (
    LBFGS,
    OCP,
    Adam,
    Demonstration,
    Descent,
    GradientDescent,
    Implicit,
    Riccati,
    Trajectory,
    Unrolled,
    learn,
)
from kpirl_ocp.errors import FileError, ProblemError
from kpirl_ocp.irl.hypergradients import ActionDistance, FiniteDifference, KeyFrames, WeightedSum, squared_distance
from kpirl_ocp.irl.learning import Learner
from kpirl_ocp.irl.learning.optimisers import Box, Point

pytestmark = pytest.mark.usefixtures("virtual_machine")

DT = 0.2


@lru_cache
def mass(horizon):
    """A mass pulled to a goal; psi = (weight of the distance, weight of the effort)."""
    s, u, psi, goal = ca.SX.sym("s", 2), ca.SX.sym("u"), ca.SX.sym("psi", 2), ca.SX.sym("goal")
    return OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        context=goal,
        dynamics=ca.vertcat(s[0] + DT * s[1], s[1] + DT * (u - 0.1 * s[1] ** 3)),
        stage_cost=psi[0] * (s[0] - goal) ** 2 + psi[1] * u**2 + 0.1 * s[1] ** 2,
        terminal_cost=(s[0] - goal) ** 2,
        horizon=horizon,
    )


TRUTH, START = np.array([0.4, 0.05]), np.array([1.0, 0.2])


def demonstrate(horizon, goal=1.0, s0=(0.0, 0.0)):
    plan = Riccati(1e-12).solve(mass(horizon), s0, TRUTH, [goal])
    return Demonstration(np.array(s0), np.array([goal]), plan.states, actions=plan.actions)


quiet = partial(learn, progress=False)


def test_demonstrations_of_different_lengths_recover_the_cost():
    demonstrations = [demonstrate(6), demonstrate(11, 0.7), demonstrate(6, -1.0)]
    found = quiet(mass, demonstrations, START, Implicit(Riccati(1e-12)), LBFGS(tolerance=0), steps=60)
    np.testing.assert_allclose(found.psi, TRUTH, rtol=1e-6)
    single = Learner(mass, demonstrations, Unrolled(GradientDescent(10, 0.02)), Adam()).evaluate(START)
    alone = [Unrolled(GradientDescent(10, 0.02))(mass(d.horizon), d, START) for d in demonstrations]
    np.testing.assert_allclose(single.gradient, np.mean([one.gradient for one in alone], axis=0), rtol=1e-12)


def test_horizons_that_do_not_fit_are_refused():
    with pytest.raises(ProblemError, match="the problem for the horizon 6 has the horizon 7"):
        quiet(lambda horizon: mass(horizon + 1), [demonstrate(6)], START, Implicit())
    hint = r"= \(8, 2\), got \(7, 2\); for demonstrations of other lengths, `learn` takes a function T -> problem"
    with pytest.raises(ProblemError, match=r"observations must be \(T\+1, n_z\) " + hint):
        quiet(mass(7), [demonstrate(6)], START, Implicit())


LOSSES = {
    "actions": ActionDistance(),
    "key frames": KeyFrames(),
    "both": WeightedSum(((0.3, ActionDistance()), (2.0, KeyFrames()))),
}


@pytest.mark.parametrize("name", LOSSES)
def test_gradients_of_other_losses_are_those_of_differences(name):
    seen = demonstrate(8)
    frames = np.array([2, 5, 8])
    sparse = Demonstration(seen.s0, seen.context, seen.observations[frames], actions=seen.actions, frames=frames)
    implicit = Implicit(Riccati(1e-12), loss=LOSSES[name])(mass(8), sparse, START)
    reference = FiniteDifference(Riccati(1e-12), loss=LOSSES[name])(mass(8), sparse, START)
    np.testing.assert_allclose(implicit.loss, reference.loss, rtol=1e-12)
    np.testing.assert_allclose(implicit.gradient, reference.gradient, rtol=1e-7)
    steps = GradientDescent(5, 0.02)
    unrolled = Unrolled(steps, loss=LOSSES[name])(mass(8), sparse, START)
    reference = FiniteDifference(steps, loss=LOSSES[name])(mass(8), sparse, START)
    np.testing.assert_allclose(unrolled.gradient, reference.gradient, rtol=1e-7)


def test_losses_are_the_sums_they_say():
    seen = demonstrate(8)
    frames = np.array([1, 4])
    sparse = Demonstration(
        seen.s0, seen.context, seen.observations[frames] + 0.1, actions=seen.actions + 0.2, frames=frames
    )
    plan = Trajectory(seen.observations, seen.actions)

    def value(loss):
        return float(loss(mass(8))(plan.states.T, plan.actions.T, loss.data(mass(8), sparse)))

    np.testing.assert_allclose(value(KeyFrames()), 2 * 2 * 0.1**2, rtol=1e-12)
    np.testing.assert_allclose(value(ActionDistance()), 8 * 0.2**2, rtol=1e-12)
    np.testing.assert_allclose(value(LOSSES["both"]), 0.3 * 8 * 0.2**2 + 2.0 * 4 * 0.1**2, rtol=1e-12)


WRONG = {
    "no actions": (ActionDistance(), {}, r"actions must be \(T, n_u\) = \(8, 1\), got none"),
    "other actions": (ActionDistance(), {"actions": np.zeros((7, 1))}, r"got \(7, 1\)"),
    "frames for all": (squared_distance, {"frames": np.arange(9)}, r"use loss=KeyFrames\(\)"),
    "a frame too late": (KeyFrames(), {"frames": np.arange(9) + 1}, "at frames up to 9"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_demonstration_that_a_loss_cannot_use_is_refused(name):
    loss, extra, message = WRONG[name]
    seen = Demonstration(np.zeros(2), np.ones(1), np.zeros((9, 2)), **extra)
    with pytest.raises(ProblemError, match=message):
        Implicit(loss=loss)(mass(8), seen, START)


@pytest.mark.parametrize("frames", [[2, 1, 3], [0.5, 1, 2], [0, 1], [-1, 0, 1]])
def test_frames_that_are_no_ascending_times_are_refused(frames):
    with pytest.raises(ProblemError, match="frames must be ascending times"):
        Demonstration(np.zeros(2), np.ones(1), np.zeros((3, 2)), frames=np.array(frames))


def hill():
    """Two minima of the plan, left and right of a hill; the demonstration goes the way that a cold start does not."""
    s, u, psi = ca.SX.sym("s", 2), ca.SX.sym("u", 2), ca.SX.sym("psi", 2)
    bump = ca.exp(-8 * ca.sumsqr(s - ca.DM([0.5, 0.02])))
    return OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        dynamics=s + 0.1 * u,
        stage_cost=psi[0] * bump + psi[1] * 0.05 * ca.sumsqr(u),
        terminal_cost=20 * ca.sumsqr(s - ca.DM([1, 0])),
        horizon=12,
    )


def test_a_start_for_a_demonstration_keeps_to_its_minimum_and_warm_starts_stay_there():
    problem, truth = hill(), np.array([1.5, 1.0])
    side = np.column_stack([np.linspace(0, 1, 13), 0.6 * np.sin(np.linspace(0, np.pi, 13))])
    above = Trajectory(side, np.diff(side, axis=0) / 0.1)
    plan = Riccati(1e-12).solve(problem, [0.0, 0.0], truth, guess=above)
    assert plan.states[6, 1] > 0.2 > Riccati().solve(problem, [0.0, 0.0], truth).states[6, 1]
    seen = Demonstration(np.zeros(2), np.zeros(0), plan.states)
    learned = quiet(problem, [seen], [1.0, 1.3], Implicit(Riccati(1e-12)), LBFGS(), steps=30, guesses=[above])
    assert learned.loss < 1e-6
    np.testing.assert_allclose(learned.psi[0] / learned.psi[1], 1.5, rtol=1e-2)
    assert all(plan.states[6, 1] > 0.2 for plan in learned.solutions)


def test_warm_starts_take_fewer_iterations_and_change_nothing_else():
    arguments = mass(8), [demonstrate(8)], START, Implicit(Riccati(1e-12)), Descent(1e-3)
    warm, cold = (quiet(*arguments, steps=4, warm_start=on) for on in (True, False))
    np.testing.assert_allclose(warm.losses, cold.losses, rtol=1e-9)
    assert warm.solutions[0].iterations < cold.solutions[0].iterations


def test_gradient_steps_start_where_they_are_told_and_are_not_warm_started():
    seen, steps = demonstrate(8), Unrolled(GradientDescent(3, 0.02))
    start = Trajectory(seen.observations, seen.actions + 0.3)
    learner = Learner(mass(8), [seen], steps, Descent(1e-3), guesses=[start])
    first = learner.init(START)
    second = learner.step(first)
    for point in (first.point, second.point):
        expected = steps(mass(8), seen, point.psi, guess=start)
        assert (point.loss, *point.gradient) == (expected.loss, *expected.gradient)


def quadratic(psi):
    """Curvatures 1, 100; the minimum at (2, 3)."""
    off = psi - np.array([2.0, 3.0])
    return Point(psi, float(off @ ([1, 100] * off)) / 2, np.array([1, 100]) * off)


@pytest.mark.parametrize("optimiser", [Descent(5e-3), Adam(0.05), LBFGS(tolerance=0)], ids=lambda o: type(o).__name__)
def test_optimisers_end_at_the_minimum_within_bounds(optimiser):
    box = Box(np.array([-1.0, -1.0]), np.array([1.5, np.inf]))
    point = quadratic(np.array([0.0, 0.0]))
    memory = optimiser.start(point)
    for _ in range(3000):
        previous = point
        point, memory = optimiser.step(quadratic, point, memory, box)
        assert (box.project(point.psi) == point.psi).all()
        if point is previous:
            break
    np.testing.assert_allclose(point.psi, [1.5, 3.0], rtol=1e-3)


def test_parameters_of_very_different_size_are_learned_with_a_scale():
    s, u, psi = ca.SX.sym("s"), ca.SX.sym("u"), ca.SX.sym("psi", 2)
    problem = OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        dynamics=0.9 * s + u,
        stage_cost=(psi[0] - s) ** 2 + 0.01 * psi[1] * u**2,
        terminal_cost=(psi[0] - s) ** 2,
        horizon=8,
    )
    truth = np.array([0.3, 400.0])
    plan = Riccati(1e-12).solve(problem, [2.0], truth)
    seen = Demonstration(np.array([2.0]), np.zeros(0), plan.states)
    arguments = problem, [seen], [0.5, 250.0], Implicit(Riccati(1e-12)), Adam(0.05)
    scaled = quiet(*arguments, steps=300, scale=[0.3, 400.0])
    np.testing.assert_allclose(scaled.psi, truth, rtol=1e-2)
    plain = quiet(*arguments, steps=300)
    assert abs(plain.psi[1] / truth[1] - 1) > 0.3  # Adam moves every entry by the same length


def test_bounds_on_psi_are_kept():
    result = quiet(mass(8), [demonstrate(8)], START, Implicit(), LBFGS(), steps=20, bounds=([0.6, 0.0], np.inf))
    assert result.psi[0] == 0.6
    assert (result.psis >= [0.6, 0.0]).all()
    refused = r"psi0 must lie within the bounds \(lower, upper\): psi0\[0\] is 1, the nearest that does 2"
    with pytest.raises(ProblemError, match=refused):
        quiet(mass(8), [demonstrate(8)], START, Implicit(), bounds=(2.0, 3.0))


@pytest.mark.parametrize("optimiser", [Descent(0.02), Adam(0.02), LBFGS(tolerance=0)], ids=lambda o: type(o).__name__)
def test_learning_that_was_interrupted_goes_on_with_the_same_bits(optimiser, tmp_path):
    arguments = mass(8), [demonstrate(8), demonstrate(8, 0.5)], START, Implicit(), optimiser
    whole = quiet(*arguments, steps=9)
    path = tmp_path / "out" / "learning.npz"
    for steps in (2, 5, 9):
        part = quiet(*arguments, steps=steps, checkpoint=path)
        assert len(part.losses) == steps + 1
    for name in ("psi", "losses", "psis", "uncertified"):
        np.testing.assert_array_equal(getattr(part, name), getattr(whole, name))
    assert (np.diff(part.seconds) >= 0).all()
    assert list(tmp_path.glob("**/*.part")) == []


def test_a_checkpoint_that_is_damaged_or_of_another_learning_is_refused_by_name(tmp_path):
    path = tmp_path / "learning.npz"
    arguments = mass(8), [demonstrate(8)], START, Implicit(), Adam()
    quiet(*arguments, steps=1, checkpoint=path)
    with pytest.raises(FileError, match=r"learning\.npz is the checkpoint of another learning"):
        quiet(*arguments[:-1], Adam(0.5), steps=1, checkpoint=path)
    bounded = replace(arguments[0], action_bounds=(-0.5, 0.5))
    with pytest.raises(FileError, match=r"learning\.npz is the checkpoint of another learning"):
        quiet(bounded, *arguments[1:], steps=1, checkpoint=path)
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(FileError, match=r"learning\.npz cannot be read"):
        quiet(*arguments, steps=1, checkpoint=path)


def test_a_callback_sees_every_step_and_can_end_learning():
    seen = []

    def callback(state):
        seen.append(state.point.loss)
        return len(seen) == 3

    result = quiet(mass(8), [demonstrate(8)], START, Implicit(), Adam(), steps=10, callback=callback)
    assert seen == result.losses[1:].tolist()
    assert len(seen) == 3
    assert not result.interrupted


def test_a_checkpoint_of_more_steps_than_are_wanted_is_refused(tmp_path):
    arguments, path = (mass(8), [demonstrate(8)], START, Implicit()), tmp_path / "learning.npz"
    quiet(*arguments, steps=3, checkpoint=path)
    assert len(quiet(*arguments, steps=3, checkpoint=path).losses) == 4
    with pytest.raises(FileError, match=r"learning\.npz holds 3 steps, more than the 2 that are wanted"):
        quiet(*arguments, steps=2, checkpoint=path)


def test_an_interruption_keeps_the_best_and_the_checkpoint(tmp_path):
    def interrupt(state):
        if len(state.memory[1]) and state.memory[0] == 4:
            raise KeyboardInterrupt

    path = tmp_path / "learning.npz"
    arguments = mass(8), [demonstrate(8)], START, Implicit(), Adam(0.1)
    result = quiet(*arguments, steps=10, callback=interrupt, checkpoint=path)
    assert result.interrupted
    assert len(result.losses) == 5
    assert result.loss == result.losses.min()
    np.testing.assert_array_equal(
        quiet(*arguments, steps=10, checkpoint=path).losses, quiet(*arguments, steps=10).losses
    )


REFUSED = {
    "guesses for others": ({"guesses": [None, None]}, "there must be 1 guesses, one per demonstration"),
    "one guess": ({"guesses": Trajectory(np.zeros((9, 2)), np.zeros((8, 1)))}, "there must be 1 guesses"),
    "negative scale": ({"scale": [1.0, -2.0]}, "scale must be positive, a number or"),
    "scale of another length": ({"scale": [1.0, 2.0, 3.0]}, r"scale must be positive, a number or \(2,\)"),
    "scale that is no number": ({"scale": np.nan}, "scale must be positive"),
    "bounds of another length": ({"bounds": ([0, 0, 0], 1)}, r"bounds must be \(lower, upper\), each a number or \(2,"),
    "one bound": ({"bounds": 1.0}, r"bounds must be \(lower, upper\), got 1.0"),
    "psi0 of words": ({"psi0": "psi"}, "psi0 must be an array of numbers"),
    "psi0 of another length": ({"psi0": [1.0]}, "psi0 must have length 2, got 1"),
    "psi0 that is no number": ({"psi0": [np.nan, 1.0]}, "psi0 must be finite"),
    "psi0 out of bounds": ({"bounds": (2.0, 3.0)}, "psi0 must lie within the bounds"),
    "no demonstrations": ({"demonstrations": []}, "at least one demonstration"),
    "one demonstration": ({"demonstrations": 3}, "demonstrations must be a sequence of Demonstration, got 3"),
    "states for demonstrations": ({"demonstrations": [np.zeros((9, 2))]}, "demonstrations must be a sequence of"),
    "half a step": ({"steps": 2.5}, "steps must be a whole number of at least 0, got 2.5"),
    "steps back": ({"steps": -1}, "steps must be a whole number of at least 0, got -1"),
    "a class of gradients": ({"hypergradient": Implicit}, r"hypergradient must be an object such as Implicit\(\)"),
    "a class of optimisers": ({"optimiser": Adam}, r"optimiser must be an object such as Adam\(\)"),
    "an optimiser's name": ({"optimiser": "adam"}, r"optimiser must be an object such as Adam\(\), got 'adam'"),
    "no callback": ({"callback": 3}, "callback must be a function of the state, got 3"),
    "no problem": ({"problem": 3}, "problem must be an OCP, or a function T -> OCP, got 3"),
    "a function of nothing": (
        {"problem": lambda horizon: None},
        "the problem for the horizon 8 must be an OCP, got None",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_an_argument_that_does_not_fit_is_refused_in_one_sentence(name):
    changes, message = REFUSED[name]
    arguments = {"problem": mass(8), "demonstrations": [demonstrate(8)], "psi0": START, "hypergradient": Implicit()}
    with pytest.raises(ProblemError, match=message):
        quiet(**(arguments | changes))


@pytest.mark.parametrize(
    "parts", [(), ActionDistance(), ((1.0,),), ((ActionDistance(), 1.0),), (1.0, ActionDistance())]
)
def test_a_sum_without_weights_or_losses_is_refused(parts):
    with pytest.raises(ProblemError, match=r"parts must be pairs \(weight, loss\), at least one"):
        WeightedSum(parts)


@pytest.mark.parametrize("path", [3, "file/learning.npz"])
def test_a_checkpoint_that_cannot_be_written_is_refused(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(FileError, match=r"checkpoint must be the path of a file|the checkpoint .* cannot be written"):
        quiet(mass(8), [demonstrate(8)], START, Implicit(), steps=1, checkpoint=path)
