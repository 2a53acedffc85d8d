"""An object is followed through films, tracks come from anywhere, and what is no demonstration is refused."""

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

pytest.importorskip("av")
pytest.importorskip("cv2")
from films import HEIGHT, WALL, WIDTH, film, paste, pose, texture

from kpirl_ocp.errors import DemonstrationError, FileError
from kpirl_ocp.perception.data.video import iterate_frames
from kpirl_ocp.perception.tracking import objects
from kpirl_ocp.perception.tracking.admission import check_steps, good_until, moving_part, refusal
from kpirl_ocp.perception.tracking.appearance import Memory, Views
from kpirl_ocp.perception.tracking.identity.lookalikes import Lookalikes
from kpirl_ocp.perception.tracking.pictures import at_times, captioned, overlay, overlays, track_film, track_sheet
from kpirl_ocp.perception.tracking.similarity import apart, fit, transform
from kpirl_ocp.perception.tracking.tracker import Located, track
from kpirl_ocp.perception.tracking.tracks import Tracks, of_object, read_tracks, spread, write_tracks

CORNERS = np.array([[10.0, 10], [40, 10], [40, 40], [10, 40]])  # points on the picture of 50 x 50 pixels
SIZE = (WIDTH, HEIGHT)


def followed(frames, poses):
    """Tracks of four points on the picture, and where they are in truth."""
    truth = np.array([transform(where, CORNERS) for where in poses])
    mask = np.zeros((HEIGHT, WIDTH), bool)
    (left, top), (right, bottom) = truth[0].min(axis=0).astype(int) - 8, truth[0].max(axis=0).astype(int) + 8
    mask[top:bottom, left:right] = True
    return of_object(track(frames, mask), truth[0], SIZE), truth


def errors(tracks, truth):
    """(n, K) [pixels]."""
    return np.linalg.norm(tracks.positions - truth, axis=-1)


# Following


def test_a_rigid_object_is_followed_to_a_fraction_of_a_pixel_while_it_turns_and_comes_nearer():
    steps = np.linspace(0, 1, 40)
    poses = [pose(70 + 150 * t, 110 - 40 * t, 0.8 * t, 1 + 0.3 * t) for t in steps]
    tracks, truth = followed(film(poses), poses)
    assert np.median(errors(tracks, truth)) < 0.5
    assert errors(tracks, truth).max() < 2
    assert tracks.confidence.min() > 0.5


def test_points_that_are_hidden_are_restored_by_the_others():
    poses = [pose(60 + 4 * i, 90) for i in range(40)]
    occluders = [(130 + 0.1 * i, 45) for i in range(40)]  # covers the upper part as the object passes
    tracks, truth = followed(film(poses, occluders=occluders), poses)
    assert errors(tracks, truth).max() < 2


def test_an_object_that_vanishes_behind_another_is_unsure_and_found_again():
    places = [*range(60, 100, 2), *[100] * 20, *range(100, 140, 2)]
    poses = [pose(x, 90) for x in places]
    occluders = [None] * 22 + [(100, 90)] * 12 + [None] * 26
    tracks, truth = followed(film(poses, occluders=occluders), poses)
    assert tracks.confidence[23:33].max() == 0
    assert tracks.confidence[-5:].min() > 0.5
    assert errors(tracks, truth)[-1].max() < 3


def test_an_object_that_is_not_found_goes_straight_from_where_it_was_found_last_to_where_it_is_found_next():
    seen = np.array([True, True, False, False, False, True, False])
    shifts = [0, 1, 1, 90, 1, 9, 11]
    frames = [
        Located(
            0.1 * i, pose(x, 0, size=0), transform(pose(x, 0, size=0), CORNERS), np.full(4, found), np.ones(4, bool)
        )
        for i, (x, found) in enumerate(zip(shifts, seen, strict=True))
    ]
    tracks = of_object(frames, CORNERS, SIZE)
    np.testing.assert_allclose(tracks.centre[:, 0] - 25, [0, 1, 3, 5, 7, 9, 11], atol=1e-12)
    np.testing.assert_allclose(tracks.centre[:, 1], 25, atol=1e-12)
    np.testing.assert_array_equal(tracks.confidence.mean(axis=1) > 0, seen)


def test_poses_are_as_far_apart_as_the_point_that_they_move_farthest_apart():
    turned = pose(0, 0, np.pi / 2, size=0)
    assert apart(turned, np.eye(3), np.array([[1.0, 0], [3, 4]])) == pytest.approx(5 * np.sqrt(2), rel=1e-12)


def test_a_twin_that_rests_is_not_taken_for_an_object_that_is_hidden():
    image, picture = WALL, texture(1, 50, 50)
    frames = []
    for index in range(60):
        image = paste(paste(WALL, picture, pose(220, 90)), picture, pose(min(60 + 3 * index, 120), 90))
        frames.append((index / 30, paste(image, texture(2, 60, 60), pose(120, 90, size=60)) if index > 25 else image))
    truth = transform(pose(60, 90), CORNERS)
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[57:123, 27:93] = True
    tracks = of_object(track(frames, mask), truth, SIZE)
    assert tracks.confidence[:20].min() > 0.5
    assert tracks.confidence[28:].max() == 0
    assert tracks.centre[-1] == pytest.approx([120, 90], abs=3)


def cup(seed):
    """A red picture with a faint pattern: another seed, another side of the same thing."""
    return (0.7 * np.array([220, 30, 40]) + 0.3 * texture(seed, 50, 50)).astype(np.uint8)


def cups(places, turns_at):
    """A film of three red things, the first of them at the places, which shows another side from a frame on."""
    frames = []
    for index, (x, y) in enumerate(places):
        image = paste(paste(WALL, cup(3), pose(60, 40)), cup(4), pose(200, 60))
        frames.append((index / 30, paste(image, cup(1 if index < turns_at else 2), pose(x, y))))
    return frames


def test_an_object_that_turns_among_its_likes_is_followed_by_its_outline_but_not_sure():
    places = [(60 + 4 * min(index, 50), 130) for index in range(60)]
    tracks, truth = followed(cups(places, 20), [pose(x, y) for x, y in places])
    assert errors(tracks, truth).max() < 6
    assert tracks.confidence[:20].min() > 0.5
    assert tracks.confidence[20:].max() == 0


@pytest.mark.parametrize(("offsets", "there"), [([36], True), ([36, -36], False), ([], False)])
def test_a_place_is_believed_only_if_the_object_can_be_at_no_other(offsets, there):
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[65:115, 135:185] = True
    first = Memory(Views.of(paste(WALL, cup(1), pose(160, 90))), np.eye(3))
    things = Lookalikes.of(first, mask)
    things.see(first, well=True)
    assert [things.look(Views.of(WALL)) for _ in range(5)] == 5 * [None]
    image = WALL
    for offset in offsets:
        image = paste(image, cup(1), pose(160 + offset, 90))
    found = things.look(Views.of(image))
    assert (found is not None) == there
    if found is not None:
        assert found[:2, 2] == pytest.approx([36, 0], abs=3)


def test_motion_blur_is_seen_through():
    poses = [pose(60 + 8 * i, 90) for i in range(25)]
    blur = [1, 1, 1, *[9] * 20, 1, 1]
    tracks, truth = followed(film(poses, blur=blur), poses)
    assert errors(tracks, truth).max() < 4


def test_the_same_film_gives_the_same_tracks():
    poses = [pose(60 + 6 * i, 90, 0.03 * i) for i in range(12)]
    one, other = (followed(film(poses), poses)[0] for _ in range(2))
    np.testing.assert_array_equal(one.positions, other.positions)
    np.testing.assert_array_equal(one.confidence, other.confidence)


def test_a_similarity_is_recovered_from_mostly_wrong_pairs():
    rng = np.random.default_rng(0)
    points, where = rng.uniform(0, 100, (60, 2)), pose(30, 40, 0.5, 1.2)
    targets = transform(where, points)
    targets[:35] = rng.uniform(0, 100, (35, 2))
    found, agree = fit(points, targets, 1.0)
    np.testing.assert_allclose(found, where, atol=1e-5)
    assert agree[35:].all()
    assert fit(points[:2], targets[:2], 1.0) is None


# Which object


def test_what_moves_is_found_without_being_told():
    poses = [pose(80, 100)] * 5 + [pose(80 + 4 * i, 100) for i in range(20)]
    mask = objects.moving(film(poses))
    rows, columns = np.nonzero(mask)
    assert abs(columns.mean() - 80) < 8
    assert abs(rows.mean() - 100) < 8
    assert 0.5 < mask.sum() / 50**2 < 1.7


def test_clicks_and_boxes_find_the_outline():
    image = film([pose(80, 100)])[0][1]
    for mask in (objects.in_box(image, [50, 70, 110, 130]), objects.around(image, [[70, 90], [90, 110], [70, 110]])):
        there = np.zeros_like(mask)
        there[75:125, 55:105] = True
        assert (mask & there).sum() > 0.6 * there.sum()


@pytest.mark.parametrize("box", [[-1, 0, 20, 20], [10, 10, 10, 20], [0, 0, 10, 400]])
def test_a_box_outside_the_image_is_refused(box):
    with pytest.raises(DemonstrationError, match="320 x 180"):
        objects.in_box(WALL, box)


def test_a_click_outside_the_image_is_refused():
    with pytest.raises(DemonstrationError, match="outside"):
        objects.around(WALL, [[400, 20]])


def test_a_film_in_which_nothing_moves_is_refused_with_what_to_do():
    with pytest.raises(DemonstrationError, match="say what to follow"):
        objects.moving(film([pose(80, 100)] * 10))


def test_an_object_without_texture_is_refused_with_what_to_do():
    frames = film([pose(80, 100)] * 2, picture=np.full((50, 50, 3), 200, np.uint8))
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[85:115, 65:95] = True
    with pytest.raises(DemonstrationError, match="corners"):
        list(track(frames, mask))


def test_keypoints_spread_over_the_object_around_its_middle():
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[40:60, 50:150] = True
    points = spread(mask)
    np.testing.assert_allclose(points.mean(axis=0), [100, 50], atol=0.5)
    np.testing.assert_allclose(np.ptp(points, axis=0), 2 * np.array([100, 20]) / np.sqrt(12), rtol=0.02)


# Demonstrations


def tracks_of(centres, confidence=1.0, rate=30.0):
    """Tracks of two points around centres (n, 2)."""
    positions = np.asarray(centres, float)[:, None] + [[-5, 0], [5, 0]]
    return Tracks(np.arange(len(positions)) / rate, positions, np.full(positions.shape[:2], confidence), SIZE)


WAY = np.column_stack([np.linspace(50, 150, 60), np.full(60, 80)])


def test_a_motion_that_is_seen_is_a_demonstration():
    assert refusal(tracks_of(WAY)) is None


def test_keypoints_that_hardly_move_are_refused():
    found = refusal(tracks_of(WAY[0] + 0.03 * (WAY - WAY[0])))
    assert "hardly move: 3.0 pixels at most, in frames of 320 x 180." in found.reason
    assert found.frames == (0, 59)


def test_keypoints_that_jump_are_refused_at_the_frame_where_they_do():
    jumped = WAY.copy()
    jumped[40:] += [0, 60]
    found = refusal(tracks_of(jumped))
    assert "jump at 1.33 s, by 60 pixels" in found.reason
    assert found.frames == (39, 40)


def test_keypoints_that_are_not_seen_are_refused_with_the_time():
    hidden = tracks_of(WAY)
    hidden.confidence[20:40] = 0
    found = refusal(hidden)
    assert "from 0.67 to 1.33 s" in found.reason
    assert found.frames[0] == 19
    assert 20 <= found.frames[1] < 40


def test_reasons_are_those_of_tracks_from_anywhere_so_that_none_asks_to_mark_the_object():
    jumped, still = WAY.copy(), np.repeat(WAY[:1], 60, axis=0)
    jumped[40:] += [0, 60]
    for tracks in (tracks_of(jumped), tracks_of(still), tracks_of(WAY, confidence=0.0)):
        assert not re.search("--points|--box", refusal(tracks).reason)


@pytest.mark.parametrize("hide", [slice(40, 60), slice(45, None)], ids=["and seen again", "to the end"])
def test_what_was_seen_before_the_object_was_lost_is_a_demonstration(hide):
    hidden = tracks_of(WAY)
    hidden.confidence[hide] = 0
    until = good_until(hidden)
    assert hidden.times[hide.start - 1] - 0.01 < until <= hidden.times[hide.start - 1]
    assert refusal(hidden.between(0, until)) is None


def test_the_part_before_a_jump_is_a_demonstration():
    jumped = WAY.copy()
    jumped[40:] += [0, 60]
    assert good_until(tracks_of(jumped)) == 1.3


def test_of_tracks_that_hardly_moved_when_the_object_was_lost_no_part_is_a_demonstration():
    hidden = tracks_of(WAY)
    hidden.confidence[5:] = 0
    assert good_until(hidden) is None
    assert good_until(tracks_of(np.repeat(WAY[:1], 60, axis=0))) is None


def test_steps_that_cut_the_path_short_are_too_few():
    turns = np.column_stack([np.linspace(50, 150, 121), 80 + 30 * np.sin(np.linspace(0, 8 * np.pi, 121))])
    check_steps(tracks_of(turns), 40)
    with pytest.raises(DemonstrationError, match=r"5 steps are too few for this motion of 4\.0 s.*--steps"):
        check_steps(tracks_of(turns), 5)


def test_more_steps_than_frames_are_refused():
    with pytest.raises(DemonstrationError, match=r"takes 1\.97 s and is seen in 60 frames, too few for 90 steps"):
        check_steps(tracks_of(WAY), 90)


def test_between_frames_keypoints_are_on_straight_lines():
    tracks = tracks_of(WAY)
    np.testing.assert_allclose(tracks.places_at(tracks.times), tracks.positions)
    np.testing.assert_allclose(tracks.places_at([0.5 / 30]), tracks.positions[:2].mean(axis=0)[None])


def test_the_rest_before_and_after_is_left_out():
    still = np.vstack([np.repeat(WAY[:1], 60, 0), WAY, np.repeat(WAY[-1:], 60, 0)])
    start, end = moving_part(tracks_of(still))
    assert 1.85 < start < 2.05
    assert 3.95 < end < 4.15


# Files


def test_tracks_come_back_from_their_file(tmp_path):
    tracks = tracks_of(WAY, confidence=0.7)
    again = read_tracks(write_tracks(tmp_path / "tracks.npz", tracks))
    for name in ("times", "positions", "confidence"):
        np.testing.assert_array_equal(getattr(again, name), getattr(tracks, name))
    assert again.size == SIZE


def test_tracks_of_other_programs_are_read(tmp_path):
    tracks = tracks_of(WAY)
    seen = np.ones((60, 2), bool)
    seen[3, 1] = False
    np.savez(tmp_path / "cotracker.npz", pred_tracks=tracks.positions[None], pred_visibility=seen[None])
    np.savez(tmp_path / "tapir.npz", tracks=tracks.positions, occluded=~seen)
    for name in ("cotracker.npz", "tapir.npz"):
        found = read_tracks(tmp_path / name, rate=30, size=SIZE)
        np.testing.assert_array_equal(found.positions, tracks.positions)
        np.testing.assert_array_equal(found.confidence, seen)
        np.testing.assert_allclose(found.times, tracks.times)


def test_a_table_of_tracks_is_read_in_any_order_of_its_rows(tmp_path):
    path = tmp_path / "tracks.csv"
    path.write_text("frame,point,x,y,visibility\n1,b,4,5,0.5\n0,a,1,2,1\n1,a,2,2,1\n0,b,3,4,1\n2,a,3,2,1\n")
    found = read_tracks(path, rate=10, size=SIZE)
    np.testing.assert_array_equal(found.positions[:2], [[[3, 4], [1, 2]], [[4, 5], [2, 2]]])
    np.testing.assert_array_equal(found.confidence, [[1, 1], [0.5, 1], [0, 1]])
    np.testing.assert_allclose(found.times, [0, 0.1, 0.2])


def test_frames_of_a_table_are_counted_from_the_first_of_the_film(tmp_path):
    path = tmp_path / "tracks.csv"
    path.write_text("frame,point,x,y\n6,a,1,2\n8,a,2,2\n11,a,3,2\n")
    np.testing.assert_allclose(read_tracks(path, rate=10, size=SIZE).times, [0.6, 0.8, 1.1])


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("missing.npz", None, "there are no tracks"),
        ("other.txt", "x", "come as .npz or .csv"),
        ("empty.csv", "time,point,x,y\n", "no rows"),
        ("names.csv", "a,b\n1,2\n", "no column point, x, y, frame; it has a, b"),
        ("words.csv", "time,point,x,y\n0,a,left,2\n", "line 2, x: expected a number, got 'left'"),
        ("noise.npz", "not a zip", "cannot be read"),
    ],
)
def test_files_that_hold_no_tracks_are_named_with_the_reason(tmp_path, name, content, message):
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(FileError, match=message) as caught:
        read_tracks(tmp_path / name, rate=10)
    assert name in str(caught.value)


def test_tracks_without_times_need_a_frame_rate_and_nan_is_never_visible(tmp_path):
    np.savez(tmp_path / "t.npz", tracks=WAY[:, None])
    with pytest.raises(FileError, match="frame rate"):
        read_tracks(tmp_path / "t.npz")
    np.savez(tmp_path / "nan.npz", tracks=np.where(np.arange(60)[:, None, None] == 3, np.nan, WAY[:, None]))
    with pytest.raises(FileError, match="NaN"):
        read_tracks(tmp_path / "nan.npz", rate=10, size=SIZE)


# Pictures


def test_the_film_and_the_sheet_show_the_tracks(tmp_path):
    frames, tracks = film([pose(x, y) for x, y in WAY[:6]]), tracks_of(WAY[:6])
    drawn = list(overlays(frames, tracks))
    assert [image.shape for image in drawn] == [(HEIGHT, WIDTH, 3)] * 6
    x, y = tracks.positions[-1, 0].round().astype(int)
    assert tuple(drawn[-1][y, x]) == (0, 114, 178)  # the first colour
    height, width, _ = imread(track_sheet(tmp_path / "sheet.png", frames, tracks, [0, 5])).shape
    assert width / height == pytest.approx(900 / (442 * HEIGHT / WIDTH + 28), rel=0.01)  # two frames, no empty places
    found = list(iterate_frames(track_film(tmp_path / "film.mp4", frames, tracks)))
    assert len(found) == 6


def test_a_dot_is_above_the_paths_of_others():
    trails = np.array([[[50.0, 20], [20, 50]], [[50, 80], [80, 50]]])  # the second path crosses the end of the first
    trails[-1, 0] = [50, 50]
    assert tuple(overlay(WALL, trails)[50, 50]) == (0, 114, 178)


def test_a_trail_is_a_second_long_whatever_the_rate():
    for rate in (10, 30, 60):
        places = np.column_stack([np.linspace(20, 300, 2 * rate + 1), np.full(2 * rate + 1, 90)])  # in two seconds
        tracks = tracks_of(places, rate=rate)
        *_, last = overlays(((time, WALL) for time in tracks.times), tracks)
        drawn = np.flatnonzero(np.any(last[90] != WALL[90], axis=-1))
        assert drawn.min() == pytest.approx(160 - 5, abs=3)  # the first keypoint, 5 pixels to the left


def test_the_film_says_the_time_and_how_much_is_seen():
    tracks = tracks_of(WAY[:2], confidence=0.5)
    for image, text in zip(overlays([(0.0, WALL), (1 / 30, WALL)], tracks), ("0.00", "0.03"), strict=True):
        expected = captioned(WALL, f"{text} s, seen 50%")
        np.testing.assert_array_equal(image[:30, :180], expected[:30, :180])
        assert (image[:30, :180] != WALL[:30, :180]).any()


def test_tracks_of_another_rate_are_drawn_into_the_nearest_frames():
    images = [np.full((2, 2, 3), index, np.uint8) for index in range(4)]
    frames = [(0.1 * index, image) for index, image in enumerate(images)]
    shown = [int(image[0, 0, 0]) for image in at_times(frames, np.array([0.0, 0.04, 0.06, 0.19, 0.3, 0.4]))]
    assert shown == [0, 0, 1, 2, 3, 3]
    dense = [int(image[0, 0, 0]) for image in at_times(frames, np.linspace(0, 0.3, 100))]  # 33 times the film's rate
    np.testing.assert_array_equal(dense, np.round(np.linspace(0, 3, 100)))


def test_tracks_that_go_on_after_the_film_are_refused():
    frames = [(0.1 * index, np.zeros((2, 2, 3), np.uint8)) for index in range(4)]
    with pytest.raises(DemonstrationError, match=r"until 1\.00 s, but the film ends at 0\.30 s.*--source-rate"):
        list(at_times(frames, np.linspace(0, 1, 11)))


# Real clips; none of them is part of the project


LABELS = json.loads((Path(__file__).parent / "data" / "video_labels.json").read_text())


@pytest.fixture(scope="module")
def clips():
    folder = os.environ.get("KPIRL_VIDEOS")
    if not folder:
        pytest.skip("needs real clips that are not part of the project: set KPIRL_VIDEOS to their folder")
    return Path(folder)


def clip_errors(path, label, end=np.inf):
    """Distances [pixels] between where the labelled centre of the first frame is followed to, and the labels."""
    first = next(iterate_frames(path, longest=640))[1]
    mask = objects.in_box(first, label["box"])
    places = {int(frame): np.array(place) for frame, place in label["frames"].items()}
    found = enumerate(track(iterate_frames(path, longest=640, end=end), mask))
    return np.array(
        [np.linalg.norm(transform(at.pose, places[0]) - places[i]) for i, at in found if i in places and i > 0]
    )


def test_a_mirror_like_kettle_is_followed_through_the_whole_clip(clips):
    found = clip_errors(clips / "kettle.mp4", LABELS["kettle"])
    assert len(found) == 23
    assert np.median(found) < 6
    assert np.mean(found < 15) >= 0.9


def test_a_cup_is_followed_through_blur_and_behind_another_and_from_hand_to_hand(clips):
    found = clip_errors(clips / "cups.mp4", LABELS["cups"], end=160 * 1001 / 30000)
    assert len(found) == 24
    assert np.median(found) < 6
    assert np.mean(found < 15) >= 0.9


def test_a_cup_that_is_lost_among_its_likes_is_refused(clips):
    path = clips / "cups.mp4"
    mask = objects.in_box(next(iterate_frames(path, longest=640))[1], LABELS["cups"]["box"])
    tracks = of_object(track(iterate_frames(path, longest=640), mask), spread(mask), (640, 360))
    assert refusal(tracks) is not None
