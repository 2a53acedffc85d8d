"""The symbolic kinematics against Pinocchio and closed forms, and what a robot description may not be."""

import subprocess
import sys

import numpy as np
import pinocchio as pin
import pytest

from kpirl_ocp.errors import DependencyError, RobotError
from kpirl_ocp.ocp.models import Keypoint, Robot

LINKS = "".join(f'<link name="{name}"/>' for name in ("base", "slide", "turn", "skew", "hand"))
LIMIT = '<limit lower="{}" upper="{}" effort="1" velocity="1"/>'

MIMIC = '<mimic joint="motor_joint" multiplier="{}" offset="{}"/>'


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
MIMICS = (
    "".join(  # two fingers by one motor, the second the other way round, and a spindle: 3 mm a radian, from 5 mm on
        [
            '<robot name="gripper">',
            *(f'<link name="{name}"/>' for name in ("base", "arm", "motor", "other", "spindle", "tip")),
            joint("arm", "revolute", "base", "0 0 1", 'xyz="0 0 0.5" rpy="0.1 0.2 0.3"', LIMIT.format(-2, 2)),
            joint("motor", "revolute", "arm", "1 0 0", 'xyz="0 0.2 0"', LIMIT.format(-1, 1)),
            joint("other", "revolute", "arm", "1 0 0", 'xyz="0 -0.2 0"', MIMIC.format(-1, 0) + LIMIT.format(-1, 1)),
            joint("spindle", "prismatic", "motor", "0 3 4", "", MIMIC.format(3e-3, 5e-3) + LIMIT.format(0, 1)),
            joint("tip", "continuous", "other", "0 1 0", 'xyz="0.1 0 0"'),
            "</robot>",
        ]
    )
)
BENT = '<robot name="bent"><link name="base"/><link name="slide"/><link name="turn"/>{}{}</robot>'


@pytest.fixture
def urdf(tmp_path):
    def write(text):
        path = tmp_path / "robot.urdf"
        path.write_text(text)
        return path

    return write


@pytest.fixture(params=["iiwa", "panda", "ur5", "tree", "mimics"])
def robot(request, urdf):
    if request.param == "mimics":
        return Robot.from_urdf(urdf(MIMICS), {"spindle": [0.1, 0.2, 0.3], "tip": [0, 0, 0.1]})
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
def test_a_joint_moves_its_link_as_in_closed_form(case, urdf):
    link, point, theta, expected = CLOSED_FORMS[case]
    robot = Robot.from_urdf(urdf(TREE), {link: point})
    np.testing.assert_allclose(robot.locate(np.array(theta)), [expected], rtol=0, atol=1e-14)


def test_mimic_joints_follow_and_have_no_coordinate(urdf):
    robot = Robot.from_urdf(urdf(MIMICS), {"motor": [0, 0, 1], "other": [0, 0, 1], "spindle": [0, 0, 0]})
    assert robot.n_joints == 3  # arm, motor, tip
    order = [name.removesuffix("_joint") for name in robot.model.names if name.split("_")[0] in ("arm", "motor", "tip")]
    assert order == ["arm", "motor", "tip"]
    base, turned = robot.locate([0.4, 0.0, 0.0]), robot.locate([0.4, 0.3, 0.0])
    place = pin.Quaternion(pin.rpy.rpyToMatrix(0.1, 0.2, 0.3) @ pin.utils.rotate("z", 0.4)).matrix()
    np.testing.assert_allclose(base[2], [0, 0, 0.5] + place @ [0, 0.2 + 0.6 * 5e-3, 0.8 * 5e-3], rtol=0, atol=1e-15)
    up = np.array([[0, 0.2 - np.sin(0.3), np.cos(0.3)], [0, -0.2 + np.sin(0.3), np.cos(0.3)]])
    np.testing.assert_allclose(turned[:2], [0, 0, 0.5] + up @ place.T, rtol=0, atol=1e-15)
    out = 5e-3 + 3e-3 * 0.3
    np.testing.assert_allclose(np.linalg.norm(turned[2] - ([0, 0, 0.5] + place @ [0, 0.2, 0])), out, rtol=1e-12)


def test_joint_limits_are_those_of_the_joints_with_a_coordinate(urdf):
    lower, upper = Robot.from_urdf(urdf(MIMICS), {"motor": [0, 0, 0]}).joint_limits
    np.testing.assert_array_equal(lower, [-2, -1, -np.inf])
    np.testing.assert_array_equal(upper, [2, 1, np.inf])


def test_the_fingers_of_the_panda_are_one_coordinate():
    robot = Robot.from_example_data("panda", {"panda_leftfinger": [0, 0, 0], "panda_rightfinger": [0, 0, 0]})
    assert robot.n_joints == 8
    left, right = robot.locate([0, 0, 0, -1, 0, 1, 0, 0.03])
    np.testing.assert_allclose(np.linalg.norm(left - right), 0.06, rtol=1e-12)


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
    robot = Robot.from_urdf(urdf(TREE), {"hand": [0, 0, 0]})
    (lower, upper), names = robot.joint_limits, list(robot.model.names)[1:]
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


COMPLAINTS = {  # text of the file: what the parser of URDF says of it
    "<sdf/>": "Could not find the 'robot' element in the xml file",
    TREE.replace(LIMIT.format(-2, 1), ""): "Joint [skew_joint] is of type REVOLUTE but it does not specify limits",
    TREE.replace('"prismatic"', '"sliding"'): "Joint [slide_joint] has no known type [sliding]",
    TREE.replace('lower="-2"', 'lower="a"'): "joint [skew_joint]: lower value (a) is not a valid float",
    TREE.replace(LINKS, LINKS + '<link name="b"/>'): "Failed to find root link: Two root links found: [b] and [base]",
}


@pytest.mark.parametrize("text", COMPLAINTS, ids=COMPLAINTS.values())
def test_the_sentence_about_a_malformed_file_holds_the_reason_and_nothing_else_is_printed(text, urdf, capfd):
    with pytest.raises(RobotError) as caught:
        Robot.from_urdf(urdf(text))
    assert str(caught.value).endswith(f"robot.urdf cannot be read as a URDF: {COMPLAINTS[text]}.")
    assert capfd.readouterr() == ("", "")


def test_complaints_about_a_file_that_is_read_all_the_same_are_passed_on(urdf, capfd):
    picture = '<link name="base"><visual><geometry><cube/></geometry></visual></link>'
    text = MIMICS.replace('<link name="base"/>', picture)
    assert text != MIMICS
    Robot.from_urdf(urdf(text), {"tip": [(0, 0, 0)]})
    assert "Unknown geometry type 'cube'" in capfd.readouterr().err


@pytest.mark.parametrize("kind", ["floating", "planar"])
def test_an_unsupported_joint_type_is_an_error_that_names_the_joint(urdf, kind):
    text = BENT.format(joint("slide", kind, "base", "1 0 0", ""), joint("turn", "continuous", "slide", "1 0 0", ""))
    with pytest.raises(RobotError, match=r"joint 'slide_joint' is a .*revolute, continuous, prismatic"):
        Robot.from_urdf(urdf(text))


def test_a_keypoint_on_a_missing_link_is_an_error_that_lists_the_links(urdf):
    with pytest.raises(RobotError, match="no link 'elbow'; its links are: base, slide, turn, skew, hand"):
        Robot.from_urdf(urdf(TREE), (Keypoint("elbow", (0, 0, 0)),))


ARM = [  # joints and links of an arm whose last link carries more
    *(f'<link name="{name}"/>' for name in ("base", "upper", "lower")),
    joint("upper", "revolute", "base", "0 0 1", "", LIMIT.format(-1, 1)),
    joint("lower", "revolute", "upper", "0 1 0", "", LIMIT.format(-1, 1)),
]


def arm_with(*links):
    """The arm with links fixed to others: pairs of name and parent."""
    extra = [f'<link name="{name}"/>{joint(name, "fixed", parent, "1 0 0", "")}' for name, parent in links]
    return f'<robot name="arm">{"".join(ARM + extra)}</robot>'


TOOLS = {  # links beyond the arm, the tool
    "the last link": ([], "lower"),
    "what is fixed to it": ([("cup", "lower")], "cup"),
    "not a sensor on it": ([("imu_link", "lower"), ("wrist_camera", "lower"), ("LowerIMULink", "lower")], "lower"),
    "not a sensor on its holder": ([("holder", "lower"), ("optical_frame", "holder")], "holder"),
    "nothing at the base": ([("shelf", "base"), ("imu_link", "base")], "lower"),
    "tool0 before others": ([("ee_link", "lower"), ("tool0", "lower"), ("cover", "lower")], "tool0"),
    "a tool centre point": ([("hand", "lower"), ("left_tcp", "hand"), ("cover", "hand")], "left_tcp"),
    "an end effector": ([("j2_end_effector", "lower"), ("knob", "upper")], "j2_end_effector"),
}


@pytest.mark.parametrize("case", TOOLS)
def test_keypoints_are_at_the_tool_by_default(case, urdf):
    links, tool = TOOLS[case]
    assert {keypoint.link for keypoint in Robot.from_urdf(urdf(arm_with(*links))).keypoints} == {tool}


@pytest.mark.parametrize(
    ("links", "names"),
    [
        ([("thumb", "lower"), ("finger", "lower")], "finger, thumb"),
        ([("lever", "upper")], "lever, lower"),
        ([("left_tcp", "lower"), ("right_tcp", "upper")], "left_tcp, right_tcp"),
    ],
)
def test_several_possible_tools_are_an_error_that_lists_them(urdf, links, names):
    with pytest.raises(RobotError, match="2 links that could hold the tool") as caught:
        Robot.from_urdf(urdf(arm_with(*links)))
    assert f"({names})" in str(caught.value)


@pytest.mark.parametrize("limits", [(0, 0), (0.5, 0.5), (1, -1)])
def test_a_joint_without_a_range_is_an_error_that_names_it_and_its_limits(urdf, limits):
    text = arm_with().replace(LIMIT.format(-1, 1), LIMIT.format(*limits), 1)
    with pytest.raises(RobotError, match=r"joint 'upper_joint' cannot move: the limits are") as caught:
        Robot.from_urdf(urdf(text))
    assert "{:g} and {:g}".format(*limits) in str(caught.value)


def test_all_joints_without_a_range_are_named(urdf):
    with pytest.raises(RobotError, match=r"joints 'upper_joint', 'lower_joint' cannot move"):
        Robot.from_urdf(urdf(arm_with().replace(LIMIT.format(-1, 1), LIMIT.format(0, 0))))


def test_a_robot_without_joints_is_an_error(urdf):
    with pytest.raises(RobotError, match=r"robot\.urdf describes a robot without a joint that moves"):
        Robot.from_urdf(urdf('<robot name="stone"><link name="base"/></robot>'))


def test_a_xacro_file_is_an_error_with_the_command_that_expands_it(tmp_path):
    path = tmp_path / "arm.urdf.xacro"
    path.write_text("<robot/>")
    with pytest.raises(RobotError, match=r"is a xacro file, not yet a URDF: expand it with `xacro .*arm\.urdf`"):
        Robot.from_urdf(path)


def test_xacro_elements_are_found_in_a_urdf_and_not_in_its_comments(urdf):
    space = ' xmlns:xacro="http://www.ros.org/wiki/xacro"'
    harmless = arm_with().replace('name="arm"', f'name="arm"{space}').replace("</robot>", "<!-- <xacro:a/> --></robot>")
    assert Robot.from_urdf(urdf(harmless)).n_joints == 2
    with pytest.raises(RobotError, match="is a xacro file"):
        Robot.from_urdf(urdf(harmless.replace("</robot>", '<xacro:include filename="b"/></robot>')))


def test_a_mimic_joint_that_never_moves_is_an_error(urdf):
    with pytest.raises(RobotError, match="'other_joint' mimics another one with the multiplier 0"):
        Robot.from_urdf(urdf(MIMICS.replace(MIMIC.format(-1, 0), MIMIC.format(0, 0))))


def test_a_mimic_joint_that_cannot_be_followed_is_an_error(urdf):
    text = MIMICS.replace(joint("tip", "continuous", "other", "0 1 0", 'xyz="0.1 0 0"'), "").replace(
        "</robot>", joint("tip", "continuous", "other", "0 1 0", "", MIMIC.format(1, 0)) + "</robot>"
    )
    with pytest.raises(RobotError, match=r"cannot be read as a URDF: .*size") as caught:
        Robot.from_urdf(urdf(text))
    assert "/project/" not in str(caught.value)


def test_without_example_robot_data_the_message_names_the_extra(monkeypatch):
    monkeypatch.setattr(pin, "__file__", "/nowhere/pinocchio/__init__.py")
    with pytest.raises(DependencyError, match=r"'panda' .* not installed: pip install \"kpirl-ocp\[robots\]\""):
        Robot.from_example_data("panda")


def test_a_misspelt_example_robot_is_answered_with_the_nearest():
    with pytest.raises(RobotError, match=r"no robot 'pnada': did you mean 'panda'\?"):
        Robot.from_example_data("pnada")
    with pytest.raises(RobotError, match=r"no robot 'iwa': did you mean 'iiwa'\?"):
        Robot.from_example_data("iwa")


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


@pytest.mark.parametrize("kind", ["prismatic", "revolute", "continuous"])
def test_a_joint_with_an_axis_of_zero_is_named(urdf, kind):
    limit = "" if kind == "continuous" else LIMIT.format(-1, 1)
    text = '<robot name="one"><link name="base"/><link name="hand"/>' + joint("hand", kind, "base", "{}", "", limit)
    with pytest.raises(RobotError, match="joint 'hand_joint' has an axis without a direction"):
        Robot.from_urdf(urdf(text.format("0 0 0") + "</robot>"))
    robot = Robot.from_urdf(urdf(text.format("0 0 1e-3") + "</robot>"), {"hand": [0, 0, 0]})
    assert robot.n_joints == 1
