"""Films of a hand-held camera: its motion is told from the object's by the background."""

import numpy as np
import pytest

pytest.importorskip("av")
pytest.importorskip("cv2")
from films import HEIGHT, WIDTH, film, paste, pose, shaken, texture

from kpirl_ocp.errors import DemonstrationError
from kpirl_ocp.motion import minimum_jerk
from kpirl_ocp.perception.data.encoding import write_video
from kpirl_ocp.perception.tracking.camera_motion import camera_motion
from kpirl_ocp.perception.tracking.similarity import transform
from kpirl_ocp.perception.tracking.tracks import Tracks
from kpirl_ocp.perception.tracking.watch import Film, find_object, follow_object, seen_at_rest

PLACES = np.array([[20.0, 20], [300, 20], [20, 160], [300, 160]])
POSES = [pose(80 + 100 * t, 100 - 30 * t, 0.3 * t) for t in minimum_jerk(np.linspace(0, 1, 40))]


@pytest.mark.parametrize(("jitter", "drift"), [(5, (0, 0)), (15, (0, 0)), (10, (40, 10)), (15, (60, -20))])
def test_shake_and_drift_are_measured_to_a_pixel_beside_a_moving_object(jitter, drift):
    frames, cameras = shaken(POSES, jitter=jitter, drift=drift)
    found = camera_motion(frames)
    off = [transform(own, PLACES) - transform(true, PLACES) for own, true in zip(found.poses, cameras, strict=True)]
    assert np.abs(off).max() < 1
    assert np.median(np.abs(off)) < 0.1
    assert jitter < found.reach < 3 * (jitter + np.linalg.norm(drift))


def test_a_camera_at_rest_is_left_alone():
    assert camera_motion(film(POSES)) is None


def test_an_object_before_a_plain_wall_is_not_taken_for_the_background():
    wall = np.full((HEIGHT, WIDTH, 3), 150, np.uint8)
    poses = [pose(80 + 3 * index, 90, size=80) for index in range(30)]
    assert camera_motion([(i / 30, paste(wall, texture(1, 80, 80), where)) for i, where in enumerate(poses)]) is None


def test_a_picture_without_corners_tells_nothing_of_the_camera():
    assert camera_motion([(i / 30, np.full((HEIGHT, WIDTH, 3), 90 + i, np.uint8)) for i in range(10)]) is None


def test_a_camera_that_turns_away_is_refused_with_the_time_and_what_to_do():
    with pytest.raises(DemonstrationError, match=r"at 0\.\d\d s its picture has moved by 8\d of 320.*camera at rest"):
        camera_motion(shaken(POSES, jitter=3, drift=(150, 0))[0])


def test_a_background_that_is_lost_is_refused_with_the_time():
    frames, _ = shaken(POSES, jitter=10)
    dark = [(time, image if time < 0.9 else 0 * image) for time, image in frames]
    with pytest.raises(DemonstrationError, match=r"camera moves, and at 0\.90 s the background is lost"):
        camera_motion(dark)


@pytest.fixture(scope="module")
def hand_held(tmp_path_factory):
    frames, cameras = shaken(POSES, jitter=12, drift=(20, 5))
    path = tmp_path_factory.mktemp("film") / "phone.mp4"
    write_video(path, [image for _, image in frames], 30, codec="h264")
    return Film(path).steadied(), cameras


def test_an_object_in_the_film_of_a_shaking_phone_is_found_and_followed_as_if_it_stood_still(hand_held):
    film, _ = hand_held
    mask = find_object(film)
    rows, columns = np.nonzero(mask)
    assert np.hypot(columns.mean() - 80, rows.mean() - 100) < 8
    corners = np.array([[10.0, 10], [40, 10], [40, 40], [10, 40]])
    tracks = follow_object(film, mask, transform(POSES[0], corners))
    truth = np.array([transform(where, corners) for where in POSES])
    off = np.linalg.norm(tracks.positions - truth, axis=-1)
    assert np.median(off) < 1
    assert off.max() < 3


def test_tracks_of_other_programs_lose_the_shake_of_the_film(hand_held):
    film, cameras = hand_held
    seen = np.array(
        [transform(camera, transform(where, PLACES / 10)) for camera, where in zip(cameras, POSES, strict=True)]
    )
    tracks = seen_at_rest(film, Tracks(np.arange(40) / 30, seen, np.ones((40, 4)), (WIDTH, HEIGHT)))
    truth = np.array([transform(where, PLACES / 10) for where in POSES])
    assert np.abs(tracks.positions - truth).max() < 1
