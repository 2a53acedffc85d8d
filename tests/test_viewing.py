"""An arm's plan to look at: where the robot says it is, in the browser, as a video and as a recording."""

import urllib.request

import numpy as np
import pytest

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.models import Robot
from kpirl_ocp.viewing.arm_motion import ArmMotion

ROBOT = Robot.iiwa()
START = np.array([0, 0.6, 0, -1.4, 0, 1.1, 0])
JOINTS = START + np.linspace(0, 0.5, 6)[:, None] * np.array([1, 1, 0, 0, 0, 0, 0])
GOAL = ROBOT.locate(JOINTS[-1])


def test_a_motion_is_where_the_robot_says_it_is():
    motion = ArmMotion.of(ROBOT, JOINTS, 5.0)
    np.testing.assert_array_equal(motion.keypoints[3], ROBOT.locate(JOINTS[3]))
    np.testing.assert_array_equal(motion.skeletons[3][:-1], ROBOT.skeleton(JOINTS[3]))
    np.testing.assert_allclose(motion.times, [0, 0.2, 0.4, 0.6, 0.8, 1.0])
    lower, upper = motion.box()
    assert (lower <= motion.keypoints.reshape(-1, 3)).all()
    assert (upper >= motion.keypoints.reshape(-1, 3)).all()


@pytest.mark.parametrize(
    ("joints", "rate"), [(JOINTS[:, :3], 5.0), (JOINTS[0], 5.0), (JOINTS * np.nan, 5.0), (JOINTS, 0.0)]
)
def test_joints_that_do_not_fit_are_refused(joints, rate):
    with pytest.raises(ProblemError):
        ArmMotion.of(ROBOT, joints, rate)


def test_the_browser_gets_the_arm_at_the_chosen_step():
    pytest.importorskip("viser")
    from kpirl_ocp.viewing.arm_viewer import show_arm

    viewer = show_arm(ROBOT, JOINTS, 100.0, GOAL, port=18080)
    try:
        assert b"<html" in urllib.request.urlopen(viewer.url, timeout=10).read()
        viewer.play()
        assert viewer.slider.value == 5
        viewer.show(3)
        assert viewer.slider.value == 3
    finally:
        viewer.stop()


def test_a_film_shows_the_arm_move(tmp_path):
    pytest.importorskip("av")
    from kpirl_ocp.perception.data.decoding import decode
    from kpirl_ocp.viewing.arm_film import film_arm

    path = film_arm(tmp_path / "plan.mp4", ROBOT, JOINTS, 5.0, GOAL)
    frames = [image for _, image in decode(path)]
    assert len(frames) == 6
    assert frames[0].shape == (600, 600, 3)
    assert (np.abs(frames[0].astype(int) - frames[-1]).max(axis=2) > 50).sum() > 200


def test_a_recording_for_rerun_is_written(tmp_path):
    pytest.importorskip("rerun")
    from kpirl_ocp.viewing.rerun_file import write_rerun

    path = write_rerun(tmp_path / "plan.rrd", ROBOT, JOINTS, 5.0, GOAL)
    assert path.read_bytes()[:3] == b"RRF"
