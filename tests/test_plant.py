"""The simulated robot behind its camera: what spoils images, what is remembered of every look, and how old it is."""

from dataclasses import dataclass

import numpy as np
import pytest

pytest.importorskip("pybullet")
pytest.importorskip("torch")
pytest.importorskip("cv2")

from kpirl_ocp.errors import SceneError
from kpirl_ocp.perception.plant.asynchronous_plant import AsynchronousPlant
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


def moved(kind, rate, steps, **settings):
    """A plant after some steps, and what its detector was shown."""
    detector = FixedDetector([])
    with Scene(rate=rate) as scene:
        scene.reset(inverse_kinematics(0.62, 0.55))
        plant = kind(scene, detector, **settings)
        plant.look()
        for _ in range(steps):
            plant.act(np.eye(7)[5] * 0.2)
            plant.look()
    return plant, detector.shown


def test_a_detector_beside_the_controller_sees_the_arm_as_it_was_some_ticks_before():
    plant, _ = moved(
        AsynchronousPlant, rate=5, steps=2
    )  # images at ticks 4, 12, .. of 48, ready 8 later: the one of 36
    with Scene(rate=5) as scene:
        scene.reset(inverse_kinematics(0.62, 0.55))
        for look in (1, 2):
            scene.command(np.eye(7)[5] * 0.2)
            for tick in range(1, 49):
                scene.tick()
                if tick == 36:
                    np.testing.assert_array_equal(plant.images[look], scene.render().rgb)
            assert not np.array_equal(plant.images[look], scene.render().rgb)
    assert plant.ages == pytest.approx([0, 0.05, 0.05])


@pytest.mark.parametrize(
    ("rate", "latency", "phase"), [(1, 0.0, 0.3), (5, 1 / 30, 0.9), (60, 1 / 30, 0.5), (48, 0.05, 0.0)]
)
def test_keypoints_are_at_least_one_latency_and_less_than_one_image_more_old(rate, latency, phase):
    plant, shown = moved(AsynchronousPlant, rate, steps=9, latency=latency, phase=phase)
    settled = [age for look, age in enumerate(plant.ages) if look / rate >= latency + 1 / 30]
    assert settled
    assert min(settled) >= latency - 1e-9
    assert max(settled) < latency + 1 / 30 - 1e-9
    assert len(shown) <= len(plant.images)  # one that nobody reads is not rendered


def test_a_detector_without_latency_in_step_with_the_controller_is_a_synchronous_one():
    beside, _ = moved(AsynchronousPlant, rate=5, steps=3, latency=0.0, phase=0.0)
    waited, _ = moved(CameraPlant, rate=5, steps=3)
    np.testing.assert_array_equal(beside.images, waited.images)
    np.testing.assert_allclose(beside.places, waited.places, atol=1e-9)
    assert beside.ages == [0.0] * 4


@pytest.mark.parametrize("settings", [{"camera_rate": 7}, {"latency": -0.1}, {"phase": 1.0}])
def test_a_clock_that_cannot_be_is_refused(settings):
    with Scene() as scene, pytest.raises(SceneError, match=next(iter(settings))):
        AsynchronousPlant(scene, FixedDetector([]), **settings)
