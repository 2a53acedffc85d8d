"""Goals of the parts of a demonstration: where each coordinate turns back, and where it rests."""

import numpy as np
import pytest

pytest.importorskip("pinocchio")
pytest.importorskip("cv2")
pytest.importorskip("pybullet")

from test_camera_learning import SCALE, way

from kpirl_ocp.cli.imitation.arm import arm_for, other_starts
from kpirl_ocp.irl.visual.camera_learning import camera_demonstration, learn_in_image, path_distance, plan_from
from kpirl_ocp.irl.visual.parts import ends_of_rests, goals_of_parts, turning_points
from kpirl_ocp.motion import minimum_jerk


@pytest.mark.parametrize(
    ("path", "turns"),
    [
        ([0, 1, 2, 3], [3]),
        ([0, 0, 0], [2]),
        ([0, 2, 1.5, 3], [3]),  # back by less than 1
        ([0, 2, 0.5, 3], [1, 2, 3]),
        ([0, -2, -2, 0], [2, 3]),  # from where it leaves a rest
        ([0, 0.9, -2, 0], [2, 3]),
        ([0, 3, 2.5, 2, 1.5, 1], [1, 5]),  # slowly
    ],
)
def test_a_path_turns_where_it_goes_back_by_more_than_the_least(path, turns):
    assert turning_points(np.array(path, float), 1.0) == turns
    assert turning_points(-np.array(path, float), 1.0) == turns


@pytest.mark.parametrize(
    ("path", "ends"),
    [
        ([0, 1, 2, 3], []),
        ([0, 0, 0, 0], [3]),
        ([0, 0, 0, 2, 4], []),  # two steps
        ([0, 0.5, 0, 0.5, 2, 4, 4, 4, 4], [3, 8]),
        ([0, 0.3, 0.6, 0.9, 1.2, 1.5, 1.8, 2.1], [3, 7]),  # slowly
        ([0, 2, 2.5, 3, 3, 5], [4]),
    ],
)
def test_a_path_rests_where_it_stays_within_the_least_for_three_steps(path, ends):
    assert ends_of_rests(np.array(path, float), 1.0) == ends
    assert ends_of_rests(-np.array(path, float), 1.0) == ends


def test_the_goal_of_a_step_is_where_its_coordinate_turns_or_ends_to_rest_next():
    across, height, later = [0, 1, 2, 3, 4, 5], [0, 3, 3, 2, 1, 0], [0, 0, 0, 0, 2, 4]
    goals = goals_of_parts(np.array([across, height, later], float).T, 0.5)
    np.testing.assert_array_equal(goals, [[5, 3, 0], [5, 3, 0], [5, 0, 0], [5, 0, 4], [5, 0, 4]])


def lifted(steps=8, across=80.0, height=90.0):
    """Keypoints (T+1, 3, 2) that are lifted, carried and put down, slowly at first and at last."""
    t = np.linspace(0, 1, steps + 1)
    moved = np.column_stack([across * minimum_jerk(t), -height * np.sin(np.pi * minimum_jerk(t))])
    return way(across=0.0)[0] + moved[:, None]


def test_a_plan_lifts_carries_and_puts_down_from_other_starts_too():
    arm, wanted = arm_for("iiwa", None, lifted(), SCALE)
    starts = other_starts(arm, 2, seed=(0, 1))
    demonstrations = [camera_demonstration(arm.setting, arm.robot, start, wanted) for start in starts]
    learned = learn_in_image(arm.setting, arm.robot, demonstrations, rate=5.0, iterations=60).cost
    for start in other_starts(arm, 3, seed=0):
        seen = camera_demonstration(arm.setting, arm.robot, start, wanted)
        planned = plan_from(learned, arm.robot, start).states[:, : seen.observations.shape[1]]
        assert path_distance(planned, seen.observations) < 0.05
