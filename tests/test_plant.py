"""The simulated robot behind its camera: what spoils images, and what is remembered of every look."""

from dataclasses import dataclass

import numpy as np
import pytest

pytest.importorskip("pybullet")
pytest.importorskip("torch")
pytest.importorskip("cv2")

from kpirl_ocp.perception.plant.camera_plant import CameraPlant, Disturbance
from kpirl_ocp.perception.scene.bodies import BOTTLE
from kpirl_ocp.perception.scene.camera import Camera
from kpirl_ocp.perception.scene.frame import Frame
from kpirl_ocp.perception.scene.posture import inverse_kinematics
from kpirl_ocp.perception.scene.scene import Scene


@dataclass
class FixedDetector:
    """Always the same two keypoints; remembers what it was shown."""

    shown: list

    def detect(self, images):
        self.shown.append(images[0])
        return np.tile([[0.0, 0.5, 1.0], [0.9, -0.9, 0.8]], (len(images), 1, 1))


def frame():
    return Frame(np.full((100, 100, 3), 50, np.uint8), np.zeros((100, 100), bool), np.zeros(2))


def spoilt(disturbance, look=0):
    return disturbance.apply(frame(), FixedDetector([]), look, np.random.default_rng(0))


def test_an_undisturbed_image_is_the_frame():
    assert np.array_equal(spoilt(Disturbance()), frame().rgb)


def test_a_patch_hides_its_keypoint_and_nothing_else_while_it_is_there():
    patch = Disturbance(hidden=0, patch=20, since=1, until=3)
    hidden = (spoilt(patch, look=1) != 50).any(axis=-1)
    assert hidden[65:85, 40:60].all()
    assert hidden.sum() == 20 * 20
    assert [(spoilt(patch, look) != 50).any() for look in range(4)] == [False, True, True, False]


def test_a_patch_at_the_edge_of_the_image_is_cut_off():
    hidden = (spoilt(Disturbance(hidden=1, patch=20, until=1)) != 50).any(axis=-1)
    assert hidden[:15, 85:].all()
    assert hidden.sum() == 15 * 15


def test_noise_has_the_given_deviation():
    noise = spoilt(Disturbance(noise=5.0)).astype(float) - 50
    assert noise.std() == pytest.approx(5.0, rel=0.02)
    assert noise.mean() == pytest.approx(0.0, abs=0.1)


@pytest.mark.parametrize("point", [[0.5, 0.0, 0.6], [0.75, 0.0, 0.42]])
def test_a_point_of_the_arms_plane_is_found_where_the_camera_sees_it(point):
    assert np.allclose(Camera().in_plane(Camera().project(point)), point, atol=1e-12)


def test_a_plant_acts_on_the_scene_and_remembers_every_look():
    detector = FixedDetector([])
    with Scene(rate=1) as scene:
        start = inverse_kinematics(0.62, 0.55)
        scene.reset(start)
        plant = CameraPlant(scene, detector, Disturbance(noise=3.0))
        first = plant.look()
        plant.act(np.eye(7)[5] * 0.2)
        second = plant.look()
        assert np.allclose(plant.places[1], scene.camera.project(scene.link_pose(BOTTLE)[1]), atol=1e-9)
    assert np.array_equal(first.joints, start)
    assert second.joints[5] - first.joints[5] == pytest.approx(0.2, abs=0.02)
    assert np.array_equal(np.array(plant.images), np.array(detector.shown))
    assert np.linalg.norm(plant.places[1] - plant.places[0]) > 1.0
