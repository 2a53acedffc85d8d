"""An absolute confidence, a verdict before a detector is called good, devices, and going on from a trained detector."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("cv2")
pytest.importorskip("torch")
import torch
from test_detector import CLIPS, FILMS, TINY, film

from kpirl_ocp.errors import TrainingError
from kpirl_ocp.perception.detector.confidence import calibrate, without_object
from kpirl_ocp.perception.detector.detector import KeypointDetector
from kpirl_ocp.perception.detector.training import device_called, train_detector
from kpirl_ocp.perception.detector.verdict import faults

SETTINGS = replace(TINY, size=24, filters=8, batch=4, frames=4, steps=150)


@pytest.fixture(scope="module")
def detector():
    return KeypointDetector(train_detector(CLIPS, SETTINGS).model, 24)


class Pointing:
    """Stands for a detector: keypoints at given places [half an image]."""

    size = 24

    def __init__(self, places):
        self.places = places

    def detect(self, clip):
        return np.concatenate([self.places(clip), np.ones((len(clip), 2, 1))], axis=2)


def on_square(clip):
    """Twice the middle of the red square."""
    found = [np.argwhere(frame[..., 0] > 200).mean(axis=0)[::-1] + 0.5 for frame in clip]
    return np.repeat(np.array(found)[:, None] / clip.shape[1] * 2 - 1, 2, axis=1)


def test_the_confidence_is_nine_tenths_with_the_object_and_one_tenth_without():
    confidence = calibrate(np.array([[2.0, 5], [2, 5]]), np.array([[0.0, 1]]))
    peaks = torch.tensor([[2.0, 5], [0, 1], [1, 3]], dtype=torch.float64)[..., None, None]
    np.testing.assert_allclose(confidence.of(peaks), [[0.9, 0.9], [0.1, 0.1], [0.5, 0.5]])
    with pytest.raises(TrainingError, match="keypoint 1"):
        calibrate(np.array([[2.0, 1]]), np.array([[0.0, 1]]))


def test_out_of_view_is_low_for_all_keypoints(detector, tmp_path):
    seen, empty = np.concatenate([clip.images for clip in FILMS]), without_object(CLIPS)
    before = detector.detect(empty)[..., 2]
    assert before.max() == pytest.approx(1)  # relative to the largest: one of them is always sure
    sure = detector.calibrated(CLIPS)
    sure.save(tmp_path / "d.json", {"architecture": dict(size=24, keypoints=2, encoder="plain", filters=8)})
    again = KeypointDetector.load(tmp_path / "d.json")
    assert np.median(again.detect(seen)[..., 2]) > 0.85
    assert np.median(again.detect(empty)[..., 2], axis=0).max() < 0.15
    np.testing.assert_array_equal(again.detect(seen)[..., :2], detector.detect(seen)[..., :2])


def test_a_median_over_time_has_no_object():
    assert (without_object([film(3, frames=15).images])[0][..., 0] > 200).mean() < 0.02
    passing = np.full((5, 10, 10, 3), 90, np.uint8)
    for index, image in enumerate(passing):
        image[:, 2 * index : 2 * index + 2] = 255
    np.testing.assert_array_equal(without_object([passing]), 90)


def test_keypoints_on_what_moves_are_good():
    assert faults(Pointing(on_square), CLIPS) == []


def test_keypoints_that_stand_still_are_not():
    found = faults(Pointing(lambda clip: np.zeros((len(clip), 2, 2))), CLIPS)
    assert "stand still in 8 of 8 clips" in found[0]


def test_keypoints_that_tremble_stand_still():
    def trembling(clip):  # by a hundredth of an image's half to either side
        return np.broadcast_to(0.01 * (np.arange(len(clip))[:, None, None] % 2) - 0.005, (len(clip), 2, 2))

    assert "stand still in 8 of 8 clips" in faults(Pointing(trembling), CLIPS)[0]


def test_keypoints_that_move_elsewhere_are_not():
    found = faults(Pointing(lambda clip: -on_square(clip)), CLIPS)
    assert len(found) == 1
    assert "where something moves" in found[0]


def test_clips_in_which_nothing_moves_say_nothing():
    still = np.repeat(CLIPS[0][:1], 6, axis=0)
    assert "nothing moves" in faults(Pointing(on_square), [still])[0]


def test_the_noise_of_a_camera_is_no_motion():
    noise = np.random.default_rng(0).integers(-10, 11, (6, *CLIPS[0].shape[1:]))
    noisy = np.clip(CLIPS[0][:1] + noise, 0, 255).astype(np.uint8)
    assert "nothing moves" in faults(Pointing(on_square), [noisy])[0]


def test_a_trained_detector_is_good_and_training_goes_on_from_it(detector):
    assert faults(detector, [film(seed).images for seed in range(100, 104)]) == []
    more = train_detector(CLIPS, replace(SETTINGS, steps=3, step_size=1e-5), start=detector.model)
    fresh = train_detector(CLIPS, replace(SETTINGS, steps=3, step_size=1e-5))
    assert more.curves["total"][0] < 0.5 * fresh.curves["total"][0]
    with pytest.raises(TrainingError, match="another architecture"):
        train_detector(CLIPS, TINY, start=detector.model)


def test_auto_takes_a_gpu_where_there_is_one():
    assert device_called("auto").type == ("cuda" if torch.cuda.is_available() else "cpu")
    with pytest.raises(TrainingError, match="'nonsense'"):
        device_called("nonsense")
