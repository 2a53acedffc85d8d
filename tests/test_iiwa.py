"""The package's own iiwa: KUKA's dimensions, and the frames and inertias of the model that PyBullet simulates."""

import numpy as np
import pinocchio as pin
import pytest

from kpirl_ocp.assets import iiwa_urdf
from kpirl_ocp.ocp.models import Robot

SHOULDER, UPPER_ARM, FOREARM, HAND = 0.36, 0.42, 0.40, 0.081  # [m], KUKA's data sheet; the hand up to the last frame
POSES = np.random.default_rng(0).uniform(-2.0, 2.0, (100, 7))


def test_the_arm_in_the_plane_is_a_chain_of_three_rods():
    robot = Robot.iiwa({"lbr_iiwa_link_7": [0, 0, 0]})
    for theta in POSES * [0, 1, 0, 1, 0, 1, 0]:
        angles = np.array([theta[1], theta[1] - theta[3], theta[1] - theta[3] + theta[5]])
        rods = np.array([UPPER_ARM, FOREARM, HAND])
        tip = [rods @ np.sin(angles), 0.0, SHOULDER + rods @ np.cos(angles)]
        np.testing.assert_allclose(robot.locate(theta), [tip], rtol=0, atol=1e-14)


def test_limits_are_those_of_the_data_sheet():
    model = Robot.iiwa().model
    np.testing.assert_allclose(np.rad2deg(model.upperPositionLimit), [170, 120, 170, 120, 170, 120, 175], rtol=1e-14)
    np.testing.assert_array_equal(model.lowerPositionLimit, -model.upperPositionLimit)
    np.testing.assert_allclose(np.rad2deg(model.velocityLimit), [85, 85, 100, 75, 130, 135, 135], rtol=1e-14)
    np.testing.assert_array_equal(model.effortLimit, [320, 320, 176, 176, 110, 40, 40])


def test_the_description_needs_no_other_file():
    text = iiwa_urdf().read_text()
    assert "mesh filename" not in text
    assert "package://" not in text


@pytest.fixture(scope="module")
def simulated():
    """The iiwa of `pybullet_data` in Pinocchio. Its angles are rounded to 12 digits."""
    pytest.importorskip("pybullet_data")
    from kpirl_ocp.perception.scene.bodies import iiwa_with_meshes

    return pin.buildModelFromUrdf(str(iiwa_with_meshes()))


def test_every_frame_is_where_the_simulated_arm_has_it(simulated):
    own = Robot.iiwa().model
    assert list(own.names) == list(simulated.names)
    assert [frame.name for frame in own.frames] == [frame.name for frame in simulated.frames]
    for theta in POSES:
        places = []
        for model in (own, simulated):
            data = model.createData()
            pin.framesForwardKinematics(model, data, theta)
            places.append([place.homogeneous for place in data.oMf])
        np.testing.assert_allclose(*places, rtol=0, atol=1e-10)


def test_moving_links_have_the_masses_and_inertias_of_the_simulated_arm(simulated):
    for mine, other in list(zip(Robot.iiwa().model.inertias, simulated.inertias, strict=True))[1:]:  # but the base
        np.testing.assert_allclose(mine.matrix(), other.matrix(), rtol=0, atol=1e-12)
