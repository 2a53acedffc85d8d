"""The scene and its camera, against Pinocchio, PyBullet's own matrices, and itself."""

from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest

pytest.importorskip("pybullet")

import pybullet

from kpirl_ocp.errors import SceneError
from kpirl_ocp.ocp.models.robot import Robot
from kpirl_ocp.perception.scene.camera import Camera
from kpirl_ocp.perception.scene.posture import inverse_kinematics
from kpirl_ocp.perception.scene.scene import Motors, Scene

UPRIGHT = np.array([0.0, 0.6, 0.0, -1.4, 0.0, -0.43, 0.0])  # holds the bottle upright above the shelf
PLACING = np.vstack([np.tile([0, 0.05, 0, 0.02, 0, 0.03, 0], (5, 1)), np.tile([0, 0.04, 0, -0.06, 0, 0, 0], (5, 1))])


@pytest.fixture(scope="module")
def scene():
    with Scene() as opened:
        yield opened


@pytest.fixture(scope="module")
def ideal():
    with Scene(motors=Motors(ideal=True)) as opened:
        yield opened


def test_pinocchio_and_pybullet_agree_on_every_link(ideal):
    model = pin.buildModelFromUrdf(str(ideal.urdf))
    data, rng = model.createData(), np.random.default_rng(0)
    lower, upper = ideal.joint_limits
    _base, *links = (link.get("name") for link in ElementTree.parse(ideal.urdf).iter("link"))
    for _ in range(100):
        theta = rng.uniform(lower, upper)
        ideal.reset(theta)
        pin.framesForwardKinematics(model, data, theta)
        for link in links:
            rotation, position = ideal.link_pose(link)
            frame = data.oMf[model.getFrameId(link, pin.FrameType.BODY)]
            np.testing.assert_allclose(position, frame.translation, rtol=0, atol=1e-6)
            np.testing.assert_allclose(rotation, frame.rotation, rtol=0, atol=2e-6)


def test_an_arm_without_inertia_is_loaded_in_silence(tmp_path, capfd):
    joint = (
        "<parent link='a'/><child link='b'/><axis xyz='0 1 0'/><limit lower='-1' upper='1' effort='9' velocity='9'/>"
    )
    arm = f"<robot name='r'><link name='a'/><link name='b'/><joint name='j' type='revolute'>{joint}</joint></robot>"
    (tmp_path / "arm.urdf").write_text(arm)
    with Scene(arm=tmp_path / "arm.urdf", flange="b") as opened:
        np.testing.assert_array_equal(opened.joint_limits, [[-1], [1]])
    assert capfd.readouterr() == ("", "")


def test_keypoints_of_the_robot_model_are_where_the_scene_has_them(ideal):
    robot = Robot.from_urdf(ideal.urdf, {"bottle": [[0, 0, 0], [0.02, 0.01, 0.1]]})
    ideal.reset(UPRIGHT)
    rotation, position = ideal.link_pose("bottle")
    expected = [position, position + rotation @ [0.02, 0.01, 0.1]]
    np.testing.assert_allclose(robot.locate(UPRIGHT), expected, rtol=0, atol=1e-6)


def test_projection_equals_that_of_the_renderer():
    camera = Camera(width=320, height=200, eye=(0.9, -1.2, 0.8), target=(0.5, 0.1, 0.3))
    view = np.array(pybullet.computeViewMatrix(camera.eye, camera.target, camera.up)).reshape(4, 4).T
    lens = pybullet.computeProjectionMatrixFOV(camera.field_of_view, camera.width / camera.height, 0.1, 5.0)
    points = np.random.default_rng(1).uniform([0, -0.5, 0], [1, 0.5, 1], (50, 3))
    clip = np.column_stack([points, np.ones(50)]) @ (np.array(lens).reshape(4, 4).T @ view).T
    device = clip[:, :2] / clip[:, 3:]
    pixels = (device * [1, -1] + 1) / 2 * [camera.width, camera.height]
    np.testing.assert_allclose(camera.project(points), pixels, rtol=0, atol=1e-4)  # PyBullet's matrices are float32


def test_the_target_is_in_the_middle_and_a_point_behind_the_camera_is_nowhere():
    camera = Camera()
    np.testing.assert_allclose(camera.project(camera.target), [120, 120], atol=1e-10)
    assert np.isnan(camera.project(np.array(camera.eye) - [0, 0.1, 0])).all()


def test_the_bottle_is_drawn_where_it_is_projected(scene):
    for moved in ([0, 0, 0, 0, 0, 0, 0], [0, 0.3, 0, 0.2, 0, -0.1, 0], [0.1, -0.2, 0, 0, 0.1, 0, 0.8]):
        scene.reset(UPRIGHT + np.array(moved))
        rotation, position = scene.link_pose("bottle")
        rows, columns = np.nonzero(scene.render().bottle)
        foot, neck = (scene.camera.project(position + rotation @ [0, 0, z]) for z in (-0.105, 0.145))
        # The axis of the bottle, from foot to neck, spans the mask; its radius is 10 pixels at most.
        low, high = np.minimum(foot, neck), np.maximum(foot, neck)
        for pixels, axis in ((columns, 0), (rows, 1)):
            assert low[axis] - 11 <= pixels.min() <= low[axis] + 2
            assert high[axis] - 3 <= pixels.max() <= high[axis] + 11


def test_a_frame_is_an_image_of_the_camera_size_with_some_bottle_in_it():
    with Scene(camera=Camera(width=64, height=48)) as small:
        small.reset(UPRIGHT)
        frame = small.render()
    assert frame.rgb.shape == (48, 64, 3)
    assert frame.rgb.dtype == np.uint8
    assert frame.bottle.shape == (48, 64)
    assert 10 < frame.bottle.sum() < 300
    green = frame.rgb[frame.bottle].mean(axis=0)
    assert green[1] > green[0]


def run(scene):
    scene.reset(UPRIGHT)
    states = [scene.step(u) for u in PLACING]
    return np.array([state.positions for state in states]), scene.render().rgb


def test_the_same_commands_give_the_same_motion_and_frames_also_side_by_side():
    with Scene() as first, Scene() as second:
        (motion, frame), (other_motion, other_frame) = run(first), run(second)
        np.testing.assert_array_equal(motion, other_motion)
        np.testing.assert_array_equal(frame, other_frame)
        second.reset(UPRIGHT)
        np.testing.assert_array_equal(first.measure().positions, motion[-1])  # untouched by the other


def test_an_ideal_arm_integrates_its_commands(ideal):
    motion, _ = run(ideal)
    np.testing.assert_allclose(motion, UPRIGHT + np.cumsum(PLACING, axis=0), rtol=0, atol=1e-12)


def test_a_real_arm_falls_short_of_the_ideal_one_but_follows(ideal):
    with Scene(shelf=False) as free:  # the motion goes through where the shelf would be
        motion, _ = run(free)
        _, position = free.link_pose("bottle")
    wanted, _ = run(ideal)
    _, goal = ideal.link_pose("bottle")
    assert 1e-3 < np.linalg.norm(position - goal) < 0.06
    assert np.linalg.norm(motion[-1] - wanted[-1]) < 0.3 * np.linalg.norm(wanted[-1] - UPRIGHT)


def test_velocity_is_limited_and_measured(scene):
    scene.reset(UPRIGHT)
    state = scene.step(np.array([1.0, 0, 0, 0, 0, 0, 0]))
    limit = scene.motors.velocity_limit
    assert 0.8 * limit < state.velocities[0] < 1.05 * limit
    assert 0.5 * limit / scene.rate < state.positions[0] < 1.05 * limit / scene.rate


def test_joint_limits_are_respected(scene, ideal):
    lower, upper = scene.joint_limits
    for opened in (scene, ideal):
        opened.reset(upper - 0.01)
        for _ in range(3):
            state = opened.step(np.full(7, 0.5))
        assert (state.positions <= upper + 1e-3).all()
    with pytest.raises(SceneError, match="joint limits"):
        scene.reset(lower - 0.1)


def test_wrong_input_is_refused(scene):
    with pytest.raises(SceneError, match="7 finite numbers"):
        scene.step(np.zeros(6))
    with pytest.raises(SceneError, match="7 finite numbers"):
        scene.step(np.full(7, np.nan))
    with pytest.raises(SceneError, match=r"no link 'hand'.*gripper"):
        scene.link_pose("hand")
    with pytest.raises(SceneError, match="rate must divide"):
        Scene(rate=7)


def test_a_closed_scene_leaves_no_files():
    with Scene() as opened:
        urdf = opened.urdf
        assert urdf.exists()
    assert not urdf.parent.exists()


@pytest.mark.parametrize("shelf", [True, False])
def test_the_bottle_stands_on_the_shelf_and_does_not_go_through(shelf):
    with Scene(rate=1, shelf=shelf) as opened:
        opened.reset(inverse_kinematics(0.70, 0.50))
        for _ in range(3):  # five centimetres into the board, whose top is at 0.31 m
            opened.step(inverse_kinematics(0.70, 0.365) - opened.measure().positions)
        rotation, position = opened.link_pose("bottle")
        rim = [position + rotation @ [0.036 * np.cos(a), 0.036 * np.sin(a), -0.105] for a in np.linspace(0, 6.28, 50)]
    lowest = np.min(rim, axis=0)[2]
    assert lowest == pytest.approx(0.31 if shelf else 0.26, abs=2e-3)


def test_furniture_that_is_not_touched_changes_no_motion():
    def motion(shelf):
        with Scene(shelf=shelf) as opened:
            opened.reset(inverse_kinematics(0.55, 0.60))
            return [opened.step(0.2 * u).positions for u in PLACING]

    np.testing.assert_array_equal(motion(shelf=True), motion(shelf=False))
