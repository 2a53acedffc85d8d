"""The models that come with the package do on freshly rendered frames what their cards say."""

import json

import numpy as np
import pytest

pytest.importorskip("cv2")
pytest.importorskip("pybullet")
pytest.importorskip("torch")
import torch

from kpirl_ocp.assets import shipped_model
from kpirl_ocp.ocp.models.dynamics_files import load_dynamics
from kpirl_ocp.perception.data.clips import read_recordings
from kpirl_ocp.perception.data.collection import collect
from kpirl_ocp.perception.data.motions import HandPlacing, LastJoint, Placing, Sines
from kpirl_ocp.perception.detector.confidence import without_object
from kpirl_ocp.perception.detector.detector import KeypointDetector
from kpirl_ocp.perception.detector.evaluation import score
from kpirl_ocp.perception.detector.tracks import detect_tracks
from kpirl_ocp.perception.dynamics.model import DynamicsModel
from kpirl_ocp.perception.dynamics.training import score_dynamics

SEED = 4321  # of no training or test data
MOTIONS = {
    "keypoints": (LastJoint(), 8),
    "sines": (Sines(steps=20), 16),
    "placing": (Placing(), 10),
    "hand-placing": (HandPlacing(rate=5), 4),
    "hand-placing-1": (HandPlacing(rate=5, surroundings=1), 6),
    "hand-placing-2": (HandPlacing(rate=5, surroundings=2), 6),
}


@pytest.fixture(scope="module")
def fresh(tmp_path_factory):
    torch.set_num_threads(1)
    base = tmp_path_factory.mktemp("fresh")
    return {name: collect(base / name, motion, count, SEED) for name, (motion, count) in MOTIONS.items()}


@pytest.fixture(scope="module")
def detector():
    return KeypointDetector.load(shipped_model("detector"))


def card(name):
    return json.loads(shipped_model(name).read_text())


@pytest.mark.parametrize(("name", "bar"), [("keypoints", 4.0), ("sines", 6.0), ("placing", 6.0)])
def test_the_detector_follows_the_bottle_as_its_card_says(fresh, detector, name, bar):
    found = score(detector, read_recordings(fresh[name]))
    assert found.error.mean() < bar
    assert found.error.mean() < 1.5 * card("detector")["metrics"][name]["error"] + 0.5
    assert found.on_object >= 3


@pytest.mark.parametrize(("name", "bar"), [("hand-placing", 3.0), ("hand-placing-1", 6.0), ("hand-placing-2", 10.0)])
def test_the_detector_follows_the_bottle_in_a_hand_before_any_wall(fresh, detector, name, bar):
    found = score(detector, read_recordings(fresh[name]))
    assert found.displacement.max() < bar
    assert found.on_mask.min() >= 0.8


@pytest.mark.parametrize("name", ["hand-placing", "hand-placing-1", "hand-placing-2"])
def test_the_confidence_is_high_with_the_bottle_and_low_without(fresh, detector, name):
    seen = np.concatenate([recording.images for recording in read_recordings(fresh[name])])
    empty = without_object([recording.images for recording in read_recordings(fresh[name])])
    assert (detector.detect(seen)[..., 2] > 0.5).mean() > 0.9
    assert np.median(detector.detect(empty)[..., 2], axis=0).max() < 0.3


@pytest.mark.parametrize(("model", "data"), [("reaching", "sines"), ("placing", "placing")])
def test_the_dynamics_predict_one_step_and_ten(fresh, detector, model, data):
    found = score_dynamics(DynamicsModel.load(shipped_model(model)), detect_tracks(detector, fresh[data]))
    one, ten = (values.mean(axis=1) for values in (found.model[[0, -1]], found.persistence[[0, -1]]))
    assert one[0] < 0.03
    assert one[1] < 0.5 * ten[1]


@pytest.mark.parametrize(("name", "data"), [("reaching", "sines"), ("placing", "placing")])
def test_velocities_that_are_rounding_move_no_keypoint(fresh, detector, name, data):
    model, tracks = DynamicsModel.load(shipped_model(name)), detect_tracks(detector, fresh[data])
    z, theta, velocity, u = (
        torch.from_numpy(np.concatenate(values)).float()
        for values in zip(
            *[(t.keypoints[:-1, :, :2].reshape(-1, 8), t.joints[:-1], t.velocities[:-1], t.actions) for t in tracks],
            strict=True,
        )
    )
    with torch.inference_mode():
        moved = model(z, theta, velocity + 1e-4, u) - model(z, theta, velocity, u)
    assert 120 * float(moved.abs().max()) < 0.5  # [pixels]


@pytest.mark.parametrize("name", ["reaching", "placing"])
def test_planning_reads_the_same_dynamics_without_torch(name):
    trained, read = DynamicsModel.load(shipped_model(name)), load_dynamics(shipped_model(name))
    rng = np.random.default_rng(0)
    z, theta, velocity, u = rng.uniform(-0.5, 0.5, 8), rng.normal(size=7), 0.1 * rng.normal(size=7), rng.normal(size=7)
    with torch.inference_mode():
        expected = trained.double()(*(torch.from_numpy(value) for value in (z, theta, velocity, u))).numpy()
    state = np.array(read.function(0)(np.concatenate([z, theta, velocity]), u, [])).ravel()
    np.testing.assert_allclose(state[:8], expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(state[8:15], theta + u, rtol=0, atol=1e-15)
