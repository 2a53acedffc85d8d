"""The symbolic kinematics against Pinocchio and closed forms, and what a robot description may not be."""

import subprocess
import sys

import numpy as np
import pinocchio as pin
import pytest

from kpirl_ocp.errors import RobotError
from kpirl_ocp.ocp.models import Keypoint, Robot

LINKS = "".join(f'<link name="{name}"/>' for name in ("base", "slide", "turn", "skew", "hand"))
LIMIT = '<limit lower="{}" upper="{}" effort="1" velocity="1"/>'


def joint(name, kind, parent, axis, origin, limit=""):
    return (
        f'<joint name="{name}_joint" type="{kind}"><parent link="{parent}"/><child link="{name}"/>'
        f'<axis xyz="{axis}"/><origin {origin}/>{limit}</joint>'
    )


TREE = "".join(
    [
        '<robot name="tree">',
        LINKS,
        joint("slide", "prismatic", "base", "0 3 4", 'xyz="1 2 3" rpy="0 0 0"', LIMIT.format(-0.5, 0.7)),
        joint("turn", "continuous", "base", "0 0 1", 'xyz="0 0 0.4" rpy="0 0 0"'),
        joint("skew", "revolute", "turn", "1 2 3", 'xyz="0.3 0.1 -0.2" rpy="0.4 -0.7 1.1"', LIMIT.format(-2, 1)),
        joint("hand", "fixed", "skew", "1 0 0", 'xyz="0.05 0.06 0.07" rpy="-0.3 0.2 0.9"'),
        "</robot>",
    ]
)
BENT = '<robot name="bent"><link name="base"/><link name="slide"/><link name="turn"/>{}{}</robot>'


@pytest.fixture
def urdf(tmp_path):
    def write(text):
        path = tmp_path / "robot.urdf"
        path.write_text(text)
        return path

    return write


@pytest.fixture(params=["iiwa", "panda", "ur5", "tree"])
def robot(request, urdf):
    if request.param == "tree":
        return Robot.from_urdf(urdf(TREE), {"hand": [[0.1, 0.2, 0.3]], "slide": [[0, 0, 0], [0.3, -0.1, 0.2]]})
    return Robot.iiwa() if request.param == "iiwa" else Robot.from_example_data(request.param)


def poses(robot, number=50):
    """Joint positions (number, n_joints), uniform within the limits, one turn either way where there is none."""
    lower, upper = (np.clip(limit, -2 * np.pi, 2 * np.pi) for limit in robot.joint_limits)
    return np.random.default_rng(0).uniform(lower, upper, (number, robot.n_joints))


def links(robot):
    return [frame.name for frame in robot.model.frames if frame.type == pin.FrameType.BODY]


def test_symbolic_link_poses_equal_pinocchio_on_random_poses(robot):
    data, functions = robot.model.createData(), {link: robot.link_function(link) for link in links(robot)}
    assert len(functions) >= 5
    for theta in poses(robot):
        pin.framesForwardKinematics(robot.model, data, robot.configuration(theta))
        for link, function in functions.items():
            rotation, translation = (np.array(value) for value in function(theta))
            expected = data.oMf[robot.frame_id(link)]
            np.testing.assert_allclose(rotation, expected.rotation, rtol=0, atol=1e-12)
            np.testing.assert_allclose(translation.ravel(), expected.translation, rtol=0, atol=1e-12)


def test_symbolic_keypoints_equal_pinocchio_on_random_poses(robot):
    data = robot.model.createData()
    for theta in poses(robot):
        pin.framesForwardKinematics(robot.model, data, robot.configuration(theta))
        expected = [data.oMf[robot.frame_id(k.link)].act(np.array(k.position, float)) for k in robot.keypoints]
        np.testing.assert_allclose(robot.locate(theta), expected, rtol=0, atol=1e-12)


def test_keypoint_jacobian_equals_pinocchio_on_random_poses(robot):
    data, jacobian = robot.model.createData(), robot.keypoint_function.jacobian()
    for theta in poses(robot, 10):
        pin.computeJointJacobians(robot.model, data, robot.configuration(theta))
        pin.updateFramePlacements(robot.model, data)
        rows = []
        for keypoint in robot.keypoints:
            frame = robot.frame_id(keypoint.link)
            spatial = pin.getFrameJacobian(robot.model, data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
            lever = data.oMf[frame].rotation @ np.array(keypoint.position, float)
            rows.append(spatial[:3] - pin.skew(lever) @ spatial[3:])
        np.testing.assert_allclose(np.array(jacobian(theta, 0)), np.vstack(rows), rtol=0, atol=1e-12)


CLOSED_FORMS = {  # link, point on it, (slide, turn, skew), world position
    "prismatic joint moves by q along its unit axis": ("slide", (0, 0, 0), (0.5, 0, 0), (1, 2 + 0.3, 3 + 0.4)),
    "continuous joint turns by its angle": ("turn", (2, 0, 0), (0, 8.0, 0), (2 * np.cos(8.0), 2 * np.sin(8.0), 0.4)),
    "siblings do not move each other": ("slide", (0, 0, 1), (0, 1.0, 0.5), (1, 2, 4)),
}


@pytest.mark.parametrize("case", CLOSED_FORMS)
def test_closed_form(case, urdf):
    link, point, theta, expected = CLOSED_FORMS[case]
    robot = Robot.from_urdf(urdf(TREE), {link: point})
    np.testing.assert_allclose(robot.locate(np.array(theta)), [expected], rtol=0, atol=1e-14)


def test_points_on_a_skew_axis_stay_and_points_off_it_move(urdf):
    robot = Robot.from_urdf(urdf(TREE), {"skew": [[1, 2, 3], [3, 0, -1]]})
    before, after = robot.locate(np.array([0.1, 0.2, -1.0])), robot.locate(np.array([0.1, 0.2, 0.9]))
    np.testing.assert_allclose(after[0], before[0], rtol=0, atol=1e-14)
    # (3, 0, -1) is orthogonal to the axis: its chord is 2 r sin(angle / 2)
    np.testing.assert_allclose(np.linalg.norm(after[1] - before[1]), 2 * np.sqrt(10) * np.sin(0.95), rtol=1e-14)


def test_an_arm_may_have_one_joint(urdf):
    text = BENT.format(joint("slide", "prismatic", "base", "1 0 0", 'xyz="0 0 1"', LIMIT.format(-1, 1)), "")
    robot = Robot.from_urdf(urdf(text.replace('<link name="turn"/>', "")), {"slide": [0, 0, 0]})
    np.testing.assert_allclose(robot.locate(np.array([0.5])), [[0.5, 0, 1]], rtol=0, atol=1e-15)


def test_default_keypoints_of_the_iiwa_are_three_and_not_on_a_line():
    points = Robot.iiwa().locate(np.zeros(7))
    assert points.shape == (3, 3)
    assert np.linalg.norm(np.cross(points[1] - points[0], points[2] - points[0])) > 1e-3  # [m^2]


def test_joint_limits_are_those_of_the_urdf(urdf):
    lower, upper = Robot.from_urdf(urdf(TREE)).joint_limits
    names = list(Robot.from_urdf(urdf(TREE)).model.names)[1:]
    limits = {"slide_joint": (-0.5, 0.7), "turn_joint": (-np.inf, np.inf), "skew_joint": (-2, 1)}
    assert dict(zip(names, zip(lower, upper, strict=True), strict=True)) == limits


def test_joint_limits_of_the_iiwa():
    degrees = np.array([170, 120, 170, 120, 170, 120, 175])  # KUKA LBR iiwa data sheet
    lower, upper = Robot.iiwa().joint_limits
    np.testing.assert_allclose(np.rad2deg(upper), degrees, rtol=1e-9)
    np.testing.assert_array_equal(lower, -upper)


def test_a_missing_file_is_an_error_that_names_it(tmp_path):
    with pytest.raises(RobotError, match=r"no URDF file .*nowhere\.urdf"):
        Robot.from_urdf(tmp_path / "nowhere.urdf")


@pytest.mark.parametrize("text", ["", "not xml", "<robot name='a'><link name='b'/>", "<sdf/>"])
def test_a_malformed_file_is_an_error_that_names_it(urdf, text):
    with pytest.raises(RobotError, match=r"robot\.urdf cannot be read as a URDF"):
        Robot.from_urdf(urdf(text))


@pytest.mark.parametrize("kind", ["floating", "planar"])
def test_an_unsupported_joint_type_is_an_error_that_names_the_joint(urdf, kind):
    text = BENT.format(joint("slide", kind, "base", "1 0 0", ""), joint("turn", "continuous", "slide", "1 0 0", ""))
    with pytest.raises(RobotError, match=r"joint 'slide_joint' is a .*revolute, continuous, prismatic"):
        Robot.from_urdf(urdf(text))


def test_a_keypoint_on_a_missing_link_is_an_error_that_lists_the_links(urdf):
    with pytest.raises(RobotError, match="no link 'elbow'; its links are: base, slide, turn, skew, hand"):
        Robot.from_urdf(urdf(TREE), (Keypoint("elbow", (0, 0, 0)),))


def test_an_unknown_example_robot_is_an_error_that_lists_the_names():
    with pytest.raises(RobotError, match=r"no robot 'r2d2'; it has: .*panda.*ur5"):
        Robot.from_example_data("r2d2")


BAD_POINTS = [[1, 2], [[1, 2, 3, 4]], np.zeros((2, 2, 3)), [0, 0, np.nan], [[0, 0, 0], [0, np.inf, 0]]]


@pytest.mark.parametrize("points", BAD_POINTS, ids=str)
def test_keypoints_must_be_finite_points(urdf, points):
    with pytest.raises(RobotError, match=r"keypoints of link 'hand' must be finite points \(n, 3\)"):
        Robot.from_urdf(urdf(TREE), {"hand": points})


@pytest.mark.parametrize(
    "keypoints",
    [
        (Keypoint("hand", (0, 0, np.nan)),),
        (Keypoint("hand", (0, 0)),),
        {"hand": [[0, 0, 0], [0, 0]]},
        {"hand": "origin"},
    ],
    ids=str,
)
def test_keypoints_must_be_finite_points_however_they_are_given(urdf, keypoints):
    with pytest.raises(RobotError, match="finite points"):
        Robot.from_urdf(urdf(TREE), keypoints)


def test_importing_the_package_tries_no_torch_no_opencv_and_no_pybullet():
    # a finder in front of all others sees every attempt, also one that is caught, installed or not
    code = """
import sys
tried = set()
class Spy:
    def find_spec(name, path=None, target=None):
        tried.add(name)
sys.meta_path.insert(0, Spy)
import kpirl_ocp, kpirl_ocp.irl
from kpirl_ocp.ocp.models import Robot
Robot.iiwa()
print("casadi" in tried, sorted({"torch", "cv2", "pybullet"} & tried), "pybullet_data" in sys.modules)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.splitlines() == ["True [] False"]
