"""Learn a cost over keypoints from demonstrations, and plan with it.

    outer (IRL):   min_psi  L(tau(psi), tau_demo)
    inner (OCP):   tau(psi) = argmin_u  C_psi(rollout(s0, u, f), z_goal)

State a problem with `OCP`, solve it with a solver, differentiate through it with a hypergradient, learn with `learn`.
"""

from kpirl_ocp.irl.apprenticeship import apprenticeship
from kpirl_ocp.irl.evaluation import evaluate
from kpirl_ocp.irl.finite_difference import FiniteDifference
from kpirl_ocp.irl.implicit import Implicit
from kpirl_ocp.irl.learning import learn
from kpirl_ocp.irl.optimisers import LBFGS, Adam, Descent
from kpirl_ocp.irl.unrolled import Truncated, Unrolled
from kpirl_ocp.ocp.costs import RBF, Default, KeypointCost, TimeDependent, Weighted
from kpirl_ocp.ocp.fatrop import Fatrop
from kpirl_ocp.ocp.gradient_descent import GradientDescent
from kpirl_ocp.ocp.ipopt import Ipopt
from kpirl_ocp.ocp.keypoint_planning import keypoint_ocp, keypoint_state, network_ocp
from kpirl_ocp.ocp.kinematics import Keypoint, Robot
from kpirl_ocp.ocp.network import MLP
from kpirl_ocp.ocp.network_dynamics import NetworkDynamics
from kpirl_ocp.ocp.network_files import load_dynamics
from kpirl_ocp.ocp.network_onnx import load_onnx
from kpirl_ocp.ocp.problem import OCP
from kpirl_ocp.ocp.riccati import Riccati
from kpirl_ocp.ocp.sqp import SQP
from kpirl_ocp.types import Demonstration, Solution, Status, Trajectory

__all__ = [
    "LBFGS",
    "MLP",
    "OCP",
    "RBF",
    "SQP",
    "Adam",
    "Default",
    "Demonstration",
    "Descent",
    "Fatrop",
    "FiniteDifference",
    "GradientDescent",
    "Implicit",
    "Ipopt",
    "Keypoint",
    "KeypointCost",
    "NetworkDynamics",
    "Riccati",
    "Robot",
    "Solution",
    "Status",
    "TimeDependent",
    "Trajectory",
    "Truncated",
    "Unrolled",
    "Weighted",
    "apprenticeship",
    "evaluate",
    "keypoint_ocp",
    "keypoint_state",
    "learn",
    "load_dynamics",
    "load_onnx",
    "network_ocp",
]
