"""Hands: the geometry around the two networks, what is said when they are missing, and real clips where they are."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cv2")
import cv2

from kpirl_ocp.errors import DependencyError
from kpirl_ocp.perception.data.video import iterate_frames
from kpirl_ocp.perception.hands import landmarks as hands
from kpirl_ocp.perception.hands import networks as hand_files
from kpirl_ocp.perception.hands.landmarks import FINGER_TIPS, PALM, Hand, find_hands
from kpirl_ocp.perception.tracking import objects

LABELS = json.loads((Path(__file__).parent / "data" / "video_labels.json").read_text())["fingers"]


def test_the_networks_are_asked_for_with_the_command_that_brings_them(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(DependencyError, match=r"fetch them with `python\S* -m kpirl_ocp.\S+networks`"):
        hand_files.network("palm")


def test_without_its_extra_a_hand_is_not_looked_for_and_the_error_names_the_extra(monkeypatch):
    monkeypatch.setattr(hands, "Interpreter", None)
    hands._interpreter.cache_clear()
    with pytest.raises(DependencyError, match=r"kpirl-ocp\[hands\]"):
        find_hands(np.zeros((20, 20, 3), np.uint8))


def test_a_damaged_network_is_named_with_the_command_that_brings_it_again(monkeypatch, tmp_path):
    def no_model(path):
        raise ValueError(f"could not open {path}")  # as ai-edge-litert says of half a file

    monkeypatch.setattr(hands, "Interpreter", no_model)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    hands._interpreter.cache_clear()
    hand_files.folder().mkdir(parents=True)
    (hand_files.folder() / "palm.tflite").write_bytes(b"half a file")
    with pytest.raises(DependencyError, match=r"palm\.tflite is damaged: fetch it again with `python.*networks`"):
        hands.check_hands()


def test_anchors_are_the_centres_of_the_cells_twice_and_six_times():
    anchors = hands._anchors()
    assert anchors.shape == (2016, 2)
    np.testing.assert_allclose(anchors[0], [4 / 192, 4 / 192])
    np.testing.assert_allclose(anchors[[2, 1152]], [[12 / 192, 4 / 192], [8 / 192, 8 / 192]])


def test_landmarks_come_back_from_the_turned_crop_to_the_image(monkeypatch):
    """A network that finds a red dot finds it where it is, however the hand is turned."""
    image = np.zeros((200, 300, 3), np.uint8)
    cv2.circle(image, (180, 90), 3, (255, 0, 0), -1)

    def network(name, crop):
        rows, columns = np.nonzero(crop[..., 0] > 0.5)
        landmarks = np.tile([columns.mean(), rows.mean(), 0], 21)[None]
        return [landmarks.astype(np.float32), np.array([[0.9]], np.float32)]

    monkeypatch.setattr(hands, "_run", network)
    for angle in np.linspace(0, 2 * np.pi, 7):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        palm = np.array([[170.0, 100.0]] * 9)
        palm[1] = 50.0
        palm[2] += turn @ [0, 20]
        palm[4] += turn @ [0, -20]
        corner, sides = hands._upright(palm)
        np.testing.assert_allclose(np.linalg.norm(sides, axis=1), 2.6 * 50)
        found = hands._landmarks(image, corner, sides)
        np.testing.assert_allclose(found.landmarks, np.tile([180, 90], (21, 1)), atol=1)
        assert found.score == pytest.approx(0.9)


def test_a_hand_covers_its_landmarks_and_not_the_image():
    rng = np.random.default_rng(0)
    hand = Hand(rng.uniform([40, 40], [80, 90], (21, 2)), 1.0)
    mask = hand.mask((150, 150, 3))
    columns, rows = hand.landmarks.astype(int).T
    assert mask[rows, columns].all()
    assert mask.sum() < 80 * 90
    assert set(PALM).isdisjoint(FINGER_TIPS)


@pytest.fixture(scope="module")
def clips():
    folder = os.environ.get("KPIRL_VIDEOS")
    if not folder:
        pytest.skip("needs real clips that are not part of the project: set KPIRL_VIDEOS to their folder")
    if hands.Interpreter is None or not hand_files.are_there():
        pytest.skip("needs the extra `hands` and its networks")
    return Path(folder)


def test_finger_tips_are_found_where_a_person_sees_them(clips):
    errors = []
    for index, (_, image) in enumerate(iterate_frames(clips / "fingers.mp4", longest=640)):
        for tip, name in ((8, "index"), (4, "thumb")):
            if str(index) in LABELS[name]:
                errors.append(np.linalg.norm(find_hands(image)[0].landmarks[tip] - LABELS[name][str(index)]))
    assert len(errors) == 27
    assert np.median(errors) < 8  # the landmarks are in the finger, the labels at its end
    assert np.max(errors) < 15


def test_the_object_that_moves_is_found_without_the_hand_that_moves_it(clips):
    path = clips / "kettle.mp4"
    image = next(iterate_frames(path, longest=640))[1]
    hand = np.any([found.mask(image.shape) for found in find_hands(image)], axis=0)
    both, alone = (objects.moving(iterate_frames(path, longest=640), hidden) for hidden in (None, hand))
    assert (both & hand).sum() > 1000
    assert (alone & hand).sum() == 0
    assert alone[180:300, 250:330].mean() > 0.7  # the kettle
