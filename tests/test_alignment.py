"""The pose at which an object looks most like itself in an earlier frame."""

import numpy as np
import pytest

pytest.importorskip("cv2")
from films import HEIGHT, WALL, WIDTH, paste, pose, texture

from kpirl_ocp.perception.tracking.alignment import Template
from kpirl_ocp.perception.tracking.appearance import Views
from kpirl_ocp.perception.tracking.similarity import transform

START = pose(100, 90)
THING = np.zeros((HEIGHT, WIDTH), bool)
THING[67:114, 77:124] = True
CORNERS = np.array([[77.0, 67], [123, 67], [123, 113], [77, 113]])
WHERE = {
    "moved": (160.3, 80.6, 0.0, 1.0),
    "turned": (150.0, 90.0, 0.15, 1.0),
    "grown": (150.0, 90.0, 0.0, 1.12),
}


def shot(where, light=1.0, picture=None):
    picture = texture(1, 50, 50) if picture is None else picture
    image = paste(WALL, picture, where)
    return Views.of(np.clip(light * image, 0, 255).round().astype(np.uint8))


def missed(found, where):
    """Largest distance [pixels] between where a pose moves the corners, and where they are."""
    truth = where @ np.linalg.inv(START)
    return np.linalg.norm(transform(found, CORNERS) - transform(truth, CORNERS), axis=1).max()


@pytest.mark.parametrize("offset", [(0, 0), (3, -2), (-4, 3)], ids=lambda offset: f"{offset[0]}_{offset[1]}")
@pytest.mark.parametrize("name", WHERE)
def test_the_pose_is_found_to_a_quarter_of_a_pixel_from_some_pixels_away(name, offset):
    where = pose(*WHERE[name])
    guess = np.eye(3)
    guess[:2, 2] = np.array(WHERE[name][:2]) - [100, 90] + offset
    found, correlation = Template.of(shot(START), THING).align(shot(where), guess)
    assert missed(found, where) < 0.25
    assert correlation > 0.97


def test_neither_light_nor_what_is_around_the_object_draws_the_pose_along():
    where = pose(103.5, 90)
    found, correlation = Template.of(shot(START), THING).align(shot(where, light=0.7), np.eye(3))
    assert missed(found, where) < 0.1
    assert correlation > 0.97


def test_another_thing_in_the_same_place_is_far_from_alike():
    other = shot(START, picture=texture(5, 50, 50))
    assert abs(Template.of(shot(START), THING).align(other, np.eye(3))[1]) < 0.5


def test_a_thing_of_one_grey_is_like_nothing():
    flat = Views.of(np.full((HEIGHT, WIDTH, 3), 90, np.uint8))
    found, correlation = Template.of(flat, THING).align(shot(START), np.eye(3))
    assert correlation == 0.0
    np.testing.assert_array_equal(found, np.eye(3))
