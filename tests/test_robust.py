"""Domain randomisation: one frame in any surroundings, the teacher's keypoints, and the student that learns them."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("cv2")
pytest.importorskip("torch")
import torch
from test_detector import CLIPS, FILMS, TINY
from test_surroundings import clip, rng

from kpirl_ocp.cli.main import options_of
from kpirl_ocp.cli.parser import build_parser
from kpirl_ocp.errors import FileError, TrainingError
from kpirl_ocp.perception.data.surroundings import clutter, random_view, textured, without_bottle
from kpirl_ocp.perception.detector.detector import KeypointDetector
from kpirl_ocp.perception.detector.keypoints import cell_centres, to_pixels
from kpirl_ocp.perception.detector.robust import (
    TERMS,
    RobustSettings,
    Views,
    draw_views,
    in_sight,
    loss_terms,
    train_robust,
)
from kpirl_ocp.perception.detector.training import train_detector
from kpirl_ocp.perception.scene.frame import Frame

torch.set_num_threads(1)

SIZE = 24
SETTINGS = RobustSettings(steps=100, batch=12, step_size=3e-3)


def rendered(film):
    """The frames of a film as a renderer gives them: the square is body 3, and behind it is the wall, now white."""
    for image, bottle, place in zip(film.images, film.bottle, film.place, strict=True):
        yield Frame(np.where(bottle[..., None], image, 255).astype(np.uint8), bottle, place, np.where(bottle, 3, -1))


FRAMES = [frame for film in FILMS for frame in rendered(film)]


@pytest.fixture(scope="module")
def teacher():
    settings = replace(TINY, size=SIZE, filters=8, batch=4, frames=4, steps=150)
    return KeypointDetector(train_detector(CLIPS, settings).model, SIZE)


@pytest.fixture(scope="module")
def trained(teacher, tmp_path_factory):
    path = tmp_path_factory.mktemp("robust") / "checkpoint.safetensors"
    student, curves = train_robust(teacher, FRAMES, SETTINGS, checkpoint=path)
    return student, curves, path


# Views


@pytest.mark.parametrize("seed", range(8))
def test_several_points_of_the_object_stay_on_it_in_any_surroundings(seed):
    frame = clip()[1]
    corners = frame.place + np.array([[-7.0, -7], [7, -7], [7, 7], [-7, 7]])
    view = random_view(Frame(frame.rgb, frame.bottle, corners, frame.parts), rng(seed))
    assert view.rgb.shape == frame.rgb.shape
    columns, rows = np.floor(view.place).astype(int).T
    assert view.bottle[rows, columns].all()
    rows, columns = np.nonzero(view.bottle)
    np.testing.assert_allclose([columns.mean() + 0.5, rows.mean() + 0.5], view.place.mean(axis=0), atol=0.7)


def test_views_of_one_frame_differ_and_repeat_for_a_seed():
    frame = clip()[0]
    views = [random_view(frame, rng(seed)).rgb for seed in (0, 0, 1, 2, 3, 4)]
    np.testing.assert_array_equal(views[0], views[1])
    assert len({view.tobytes() for view in views}) > 3


def test_a_frame_without_the_bottle_shows_the_wall_in_its_place():
    empty = without_bottle(clip()[0])
    assert not empty.bottle.any()
    assert (empty.parts[20:36, 10:26] == -1).all()
    assert (empty.rgb[20:36, 10:26] == 255).all()
    assert (empty.rgb[45:] == 128).all()  # the other body stays


def test_texture_keeps_the_walls_colours_on_average():
    wall = np.full((64, 64, 3), 120, np.uint8)
    found = textured(wall, rng())
    assert found.dtype == np.uint8
    assert found.std() > 1
    assert abs(found.mean() - 120) < 5
    assert clutter(rng(), 64, 64).shape == textured(clutter(rng(), 64, 64), rng()).shape


# Targets


def turned(points, angle, centre=20.0):
    """Points (..., 2) by an angle [rad] around the middle of a 40 x 40 image."""
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return (np.asarray(points) - centre) @ turn.T + centre


def upright_and_lying(angles=(0, np.pi / 2, np.pi, -np.pi / 2)):
    """A 4 x 15 pixel object that something hides below, with a keypoint beside its axis, in frames that are turned."""
    bottle = np.zeros((40, 40), bool)
    bottle[5:20, 18:22] = True
    seen, hidden = [20.0, 12.0], [24.0, 24.0]
    turns = [np.rot90(bottle, -k) for k in range(4)]
    return np.array([turned([seen, hidden], angle) for angle in angles]), np.array(turns)


def test_a_hidden_keypoint_moves_with_the_object_to_where_it_is_seen():
    """No place on the line through both keypoints is farther than 4 pixels from the other and on the object."""
    keypoints, bottles = upright_and_lying()
    moved = in_sight(keypoints, bottles)
    np.testing.assert_array_equal(moved[:, 0], keypoints[:, 0])
    for place, angle in zip(moved[:, 1], (0, np.pi / 2, np.pi, -np.pi / 2), strict=True):
        np.testing.assert_allclose(place, turned(moved[0, 1], angle), rtol=0, atol=1e-12)
    x, y = moved[0, 1]
    assert 19 <= x <= 21  # a pixel from the outline
    assert 6 <= y <= 19
    assert abs(y - 12) >= 5  # the farthest such places are 6 and 7 away


@pytest.mark.parametrize("row", [10.0, 30.0])
def test_keypoints_stay_if_none_or_all_are_hidden(row):
    bottles = np.zeros((2, 40, 40), bool)
    bottles[:, 5:20] = True
    keypoints = np.full((2, 3, 2), row)
    np.testing.assert_array_equal(in_sight(keypoints, bottles), keypoints)


# Loss


def views(keypoints, present):
    return Views(torch.zeros(len(keypoints), 3, 8, 8), torch.tensor(keypoints), torch.tensor(present))


def scores_at(keypoints, cells=8, height=20.0):
    """Log-Gaussian scores with the given largest value at the nearest cell."""
    x = cell_centres(cells)
    places = torch.tensor(keypoints)
    distance = (x - places[..., :1])[..., None, :] ** 2 + (x - places[..., 1:])[..., :, None] ** 2
    scores = -0.5 * distance * (cells / 2) ** 2
    return scores - scores.amax((-2, -1), keepdim=True) + height


def test_scores_of_the_teachers_keypoints_cost_nothing():
    places = [[[0.125, -0.375], [0.375, 0.375]]]
    terms = loss_terms(scores_at(places), views(places, [True]))
    assert terms["heatmap"] == pytest.approx(0, abs=1e-5)
    assert terms["place"] == pytest.approx(0, abs=1e-2)  # from the cells near the peak alone
    assert terms["in_view"] == pytest.approx(np.log1p(np.exp(-10)), rel=1e-3)


def test_a_keypoint_beyond_the_edge_of_the_image_has_no_place_to_learn():
    places = [[[0.125, -0.375], [1.5, 0.2]]]
    terms = loss_terms(scores_at([[[0.125, -0.375], [0.9, 0.2]]]), views(places, [True]))
    assert terms["heatmap"] == pytest.approx(0, abs=1e-5)
    assert terms["place"] == pytest.approx(0, abs=1e-2)


def test_without_the_bottle_only_the_confidence_counts():
    places = [[[0.125, -0.375]]]
    terms = loss_terms(scores_at([[[0.5, 0.5]]], height=2.0), views(places, [False]))
    assert float(terms["heatmap"]) == float(terms["place"]) == 0
    assert terms["in_view"] == pytest.approx(np.log1p(np.exp(1)), rel=1e-5)
    assert terms["total"] == terms["in_view"]


# Training


def errors(detector, seed=50):
    """Distances [half an image] to the teacher's keypoints before other walls."""
    taught = [Frame(f.rgb, f.bottle, to_pixels(detector[0].detect(f.rgb[None]), 48)[0], f.parts) for f in FRAMES]
    seen = [random_view(frame, rng([seed, i])) for i, frame in enumerate(taught)]
    found = to_pixels(detector[1].detect(np.array([view.rgb for view in seen])), 48)
    return np.linalg.norm(found - np.array([view.place for view in seen]), axis=-1) / 24


def test_a_student_sees_in_any_surroundings_what_its_teacher_sees_before_the_white_wall(teacher, trained):
    student, curves, _ = trained
    assert set(curves) == set(TERMS)
    assert len(curves["total"]) == SETTINGS.steps
    assert errors((teacher, student)).mean() < 0.5 * errors((teacher, teacher)).mean()


def test_the_confidence_of_a_student_is_high_with_the_object_and_low_without(trained):
    seen = np.array([random_view(frame, rng([60, i])).rgb for i, frame in enumerate(FRAMES)])
    empty = np.array([random_view(without_bottle(frame), rng([60, i])).rgb for i, frame in enumerate(FRAMES)])
    high, low = (np.median(trained[0].detect(images)[..., 2], axis=0) for images in (seen, empty))
    assert high.min() > 0.7
    assert low.max() < 0.4


def test_a_training_that_was_killed_goes_on_as_if_it_had_not_been(teacher, trained, tmp_path):
    student, curves, path = trained
    again, found = train_robust(teacher, FRAMES, SETTINGS, checkpoint=path)
    for name in TERMS:
        np.testing.assert_array_equal(found[name], curves[name])
    np.testing.assert_array_equal(again.detect(CLIPS[0]), student.detect(CLIPS[0]))
    with pytest.raises(FileError, match="other settings or data"):
        train_robust(teacher, FRAMES, SETTINGS, seed=1, checkpoint=path)


def test_views_are_drawn_from_the_seed_and_the_step_alone():
    taught = [replace(frame, place=frame.place[None]) for frame in FRAMES]
    one, same, other = (draw_views(taught, SETTINGS, rng(seed)) for seed in ([0, 3], [0, 3], [0, 4]))
    assert torch.equal(one.images, same.images)
    assert not torch.equal(one.images, other.images)
    assert one.keypoints.shape == (SETTINGS.batch, 1, 2)


def test_nothing_to_learn_from_is_refused(teacher):
    with pytest.raises(TrainingError, match="there are none"):
        train_robust(teacher, [], SETTINGS)
    with pytest.raises(TrainingError, match="needs frames with `parts`"):
        train_robust(teacher, [replace(FRAMES[0], parts=None)], SETTINGS)
    with pytest.raises(TrainingError, match="at least 1"):
        RobustSettings(steps=0)


def test_the_commands_numbers_are_those_of_the_settings():
    parser = build_parser("train-robust", "", options_of("train-robust").add_options)
    args = parser.read(["--teacher", __file__])
    assert (args.steps, args.batch) == (RobustSettings().steps, RobustSettings().batch)
