"""Learning costs from visual demonstrations, and control from camera images."""

from kpirl_ocp.irl.visual.camera_learning import (
    CameraLearning,
    camera_demonstration,
    held_points,
    learn_in_image,
    path_distance,
    plan_from,
)
from kpirl_ocp.irl.visual.closed_loop import Execution, KeypointController, Plant
from kpirl_ocp.irl.visual.demonstrations import (
    moving_keypoints,
    positions,
    robot_demonstration,
    transferred_demonstration,
)
from kpirl_ocp.irl.visual.learning import (
    CONVERGED,
    COSTS,
    Effort,
    InnerLoop,
    LearnedPlan,
    learn_by_apprenticeship,
    learn_implicit,
    learn_unrolled,
)
from kpirl_ocp.irl.visual.parts import goals_of_parts
from kpirl_ocp.irl.visual.planning_costs import PlanningCost, planning_problem
from kpirl_ocp.irl.visual.reach import check_reach

__all__ = [
    "CONVERGED",
    "COSTS",
    "CameraLearning",
    "Effort",
    "Execution",
    "InnerLoop",
    "KeypointController",
    "LearnedPlan",
    "PlanningCost",
    "Plant",
    "camera_demonstration",
    "check_reach",
    "goals_of_parts",
    "held_points",
    "learn_by_apprenticeship",
    "learn_implicit",
    "learn_in_image",
    "learn_unrolled",
    "moving_keypoints",
    "path_distance",
    "plan_from",
    "planning_problem",
    "positions",
    "robot_demonstration",
    "transferred_demonstration",
]
