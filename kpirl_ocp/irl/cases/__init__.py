"""Example problems, the tasks of the paper, a user's own problem, and files of learned costs."""

from kpirl_ocp.irl.cases.cost_files import BASES, ArmSetting, LearnedCost, make_basis, robot_called
from kpirl_ocp.irl.cases.examples import CASES, Case, converging_descent, unconstrained
from kpirl_ocp.irl.cases.network_cases import NetworkCase, network_case, placing_case
from kpirl_ocp.irl.cases.own import OwnProblem, load_own
from kpirl_ocp.irl.cases.planar_arm import planar_dynamics, without_joints
from kpirl_ocp.irl.cases.tasks import HORIZON, TASKS, as_demonstration, demonstrate, write_demonstrations

__all__ = [
    "BASES",
    "CASES",
    "HORIZON",
    "TASKS",
    "ArmSetting",
    "Case",
    "LearnedCost",
    "NetworkCase",
    "OwnProblem",
    "as_demonstration",
    "converging_descent",
    "demonstrate",
    "load_own",
    "make_basis",
    "network_case",
    "placing_case",
    "planar_dynamics",
    "robot_called",
    "unconstrained",
    "without_joints",
    "write_demonstrations",
]
