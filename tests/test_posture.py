"""The arm in the camera's plane: closed forms, and the scene."""

import numpy as np
import pytest

pytest.importorskip("pybullet")

from kpirl_ocp.errors import SceneError
from kpirl_ocp.perception.scene.posture import UPRIGHT, inverse_kinematics
from kpirl_ocp.perception.scene.scene import Motors, Scene

SHOULDER, UPPER_ARM, FOREARM, HAND = 0.36, 0.42, 0.40, 0.196  # [m], from the URDF of the iiwa
PLACES = np.random.default_rng(0).uniform([0.56, 0.42, UPRIGHT - 0.3], [0.76, 0.72, UPRIGHT + 0.3], (50, 3))


def elbow_wrist_bottle(theta):
    """Positions (3, 2) [m] in the plane and the pitch [rad], link by link."""
    angles = np.array([theta[1], theta[1] - theta[3], theta[1] - theta[3] + theta[5]])
    links = np.array([UPPER_ARM, FOREARM, HAND])[:, None] * np.column_stack([np.sin(angles), np.cos(angles)])
    return np.array([0.0, SHOULDER]) + links.cumsum(axis=0), angles[2]


def test_the_inverse_undoes_the_forward_kinematics():
    for x, z, pitch in PLACES:
        points, turned = elbow_wrist_bottle(inverse_kinematics(x, z, pitch))
        np.testing.assert_allclose([*points[2], turned], [x, z, pitch], rtol=0, atol=1e-12)


def test_the_scene_holds_the_bottle_where_the_closed_form_says():
    with Scene(motors=Motors(ideal=True)) as scene:
        for x, z, pitch in PLACES:
            scene.reset(inverse_kinematics(x, z, pitch))
            rotation, position = scene.link_pose("bottle")
            np.testing.assert_allclose(position, [x, 0, z], rtol=0, atol=1e-6)
            np.testing.assert_allclose(rotation[:, 2], [-np.cos(pitch), 0, np.sin(pitch)], rtol=0, atol=2e-6)


def test_the_bottle_is_upright_unless_told_otherwise():
    np.testing.assert_array_equal(inverse_kinematics(0.6, 0.5), inverse_kinematics(0.6, 0.5, np.pi / 2))


def test_only_the_joints_of_the_plane_are_used_and_the_elbow_is_up():
    for x, z, pitch in PLACES:
        theta = inverse_kinematics(x, z, pitch)
        np.testing.assert_array_equal(theta[[0, 2, 4, 6]], 0.0)
        (elbow, wrist, _), _ = elbow_wrist_bottle(theta)
        across = wrist[0] * (elbow[1] - SHOULDER) - (wrist[1] - SHOULDER) * elbow[0]
        assert across > 0  # the elbow is above the line from shoulder to wrist


def test_the_arm_reaches_as_far_as_it_is_long():
    reach = UPPER_ARM + FOREARM + HAND
    np.testing.assert_allclose(
        inverse_kinematics(reach - 1e-9, SHOULDER), [0, UPRIGHT, 0, 0, 0, 0, 0], rtol=0, atol=1e-3
    )
    with pytest.raises(SceneError, match=r"cannot hold the bottle at x = 1\.017"):
        inverse_kinematics(reach + 1e-3, SHOULDER)


@pytest.mark.parametrize("place", [(HAND, SHOULDER), (np.nan, 0.5), (0.6, np.nan), (0.6, np.inf)])
def test_a_place_too_near_or_no_place_at_all_is_refused(place):
    with pytest.raises(SceneError, match="cannot hold"):
        inverse_kinematics(*place)
