"""Equal things that are moved past each other: a wrong one is never followed with confidence."""

import numpy as np
import pytest

pytest.importorskip("av")
pytest.importorskip("cv2")
from films import HEIGHT, WIDTH, pose
from shuffles import CONTROLS, SIDE, TWINS, look, rendered, together, way

from kpirl_ocp.perception.tracking.admission import refusal
from kpirl_ocp.perception.tracking.identity.twins import Twins
from kpirl_ocp.perception.tracking.tracker import track
from kpirl_ocp.perception.tracking.tracks import of_object, spread

SURE, WRONG = 0.15, SIDE / 4  # confidence that counts as seen for sure; distance that is no error of position [pixels]
HELD_OUT = range(200, 203)  # the tracker was developed on the films of smaller seeds


def followed(film):
    """Tracks of the first thing of a film, and how far its middle is from the truth (n,) [pixels]."""
    mask = np.zeros((HEIGHT, WIDTH), bool)
    (x, y), half = film.truth[0].round().astype(int), SIDE // 2 - 1
    mask[y - half : y + half, x - half : x + half] = True
    tracks = of_object(track(film.frames, mask), spread(mask), (WIDTH, HEIGHT))
    return tracks, np.linalg.norm(tracks.centre - tracks.centre[0] - film.truth + film.truth[0], axis=1)


@pytest.mark.parametrize("seed", HELD_OUT)
@pytest.mark.parametrize("make", TWINS, ids=lambda make: make.__name__)
def test_a_twin_is_never_followed_with_confidence(make, seed):
    tracks, errors = followed(make(seed))
    sure = tracks.confidence.mean(axis=1) >= SURE
    assert errors[sure].max() < WRONG
    assert refusal(tracks) is not None or errors[-1] < WRONG


@pytest.mark.parametrize("seed", HELD_OUT)
@pytest.mark.parametrize("make", CONTROLS, ids=lambda make: make.__name__)
def test_an_object_that_can_be_told_apart_is_followed_with_confidence(make, seed):
    tracks, errors = followed(make(seed))
    assert refusal(tracks) is None
    assert errors.max() < 6


def pass_by(gap, speed):
    """A film of two equal things that pass each other, the second in front, with a height between them [pixels]."""
    one = way([[60, 90 - gap / 2], [260, 90 - gap / 2]], speed, smooth=False)
    other = way([[260, 90 + gap / 2], [60, 90 + gap / 2]], speed, smooth=False)
    paths, _ = together([one, other], np.random.default_rng(0))
    return rendered(paths, np.tile([0.0, 1.0], (len(one), 1)), [look(np.random.default_rng(5))] * 2)


def test_a_thing_of_which_a_part_stays_in_view_behind_its_twin_is_followed_with_confidence():
    tracks, errors = followed(pass_by(gap=30, speed=8))
    assert refusal(tracks) is None
    assert errors.max() < 3


def test_a_thing_that_its_twin_hides_for_a_moment_is_told_from_it_by_their_ways():
    tracks, errors = followed(pass_by(gap=0, speed=4))
    assert refusal(tracks) is None
    assert errors.max() < 3


def test_a_thing_that_its_twin_hides_for_longer_is_refused_with_the_frames_from_there_on():
    tracks, _ = followed(pass_by(gap=0, speed=2))
    found = refusal(tracks)
    assert "was not seen for sure from" in found.reason
    assert 0 < found.frames[0] < len(tracks.times) / 2
    assert found.frames[-1] == len(tracks.times) - 1


# Whose a place is


def two(x):
    """The object at (100, 90), at rest, and a twin at (x, 90)."""
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[70:111, 80:121] = True
    twins = Twins.of(mask)
    twins.add(at(x))
    return twins


def at(x):
    """The pose of the object with its middle at (x, 90)."""
    return pose(x - 100, 0, size=0)


def test_a_place_is_the_objects_if_it_was_expected_there_and_the_twin_elsewhere():
    twins = two(200)
    assert twins.settle(at(103), [at(197)])
    assert not twins.confused


def test_a_place_where_the_twin_was_expected_is_the_twins_while_the_object_is_hidden():
    twins = two(140)
    assert not twins.settle(at(139), [None])
    assert not twins.confused
    assert twins.itself.unseen == 1
    assert twins.others[0].unseen == 0


@pytest.mark.parametrize(("seen", "other"), [(118, None), (119, 121)])
def test_a_place_between_the_object_and_its_twin_confuses_them_for_good(seen, other):
    twins = two(140)
    twins.settle(at(seen), [None if other is None else at(other)])
    assert twins.confused
    twins.settle(at(100), [at(140)])
    assert twins.confused


def test_a_twin_that_is_not_seen_may_be_farther_from_where_it_was():
    told_apart = []
    for unseen in (0, 8):
        twins = two(200)
        for _ in range(unseen):
            twins.settle(at(100), [None])
        twins.settle(at(108), [None])
        told_apart.append(not twins.confused)
    assert told_apart == [True, False]


def test_things_that_move_on_are_told_apart_by_their_ways():
    twins = two(240)
    for step in range(1, 10):
        assert twins.settle(at(100 + 8 * step), [at(240 - 8 * step)])
        if abs(240 - 100 - 16 * step) > 20:
            assert not twins.confused
    np.testing.assert_allclose(twins.itself.step, [8, 0])
    np.testing.assert_allclose(twins.others[0].step, [-8, 0])


def test_a_new_twin_that_is_first_seen_on_the_object_confuses_it():
    assert two(110).confused
    assert not two(140).confused
