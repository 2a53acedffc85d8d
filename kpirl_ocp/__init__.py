"""Learn a cost over keypoints from demonstrations, and plan with it.

    outer (IRL):   min_psi  L(tau(psi), tau_demo)
    inner (OCP):   tau(psi) = argmin_u  C_psi(rollout(s0, u, f), z_goal)

State a problem with `OCP`, solve it with a solver, differentiate through it with a hypergradient, learn with `learn`.
"""

from kpirl_ocp.irl.hypergradients.finite_difference import FiniteDifference
from kpirl_ocp.irl.hypergradients.implicit import Implicit
from kpirl_ocp.irl.hypergradients.unrolled import Truncated, Unrolled
from kpirl_ocp.irl.identifiability.identify import identify
from kpirl_ocp.irl.learning.apprenticeship import apprenticeship
from kpirl_ocp.irl.learning.evaluation import evaluate
from kpirl_ocp.irl.learning.learn import learn
from kpirl_ocp.irl.learning.optimisers import LBFGS, Adam, Descent
from kpirl_ocp.ocp.models.dynamics_files import load_dynamics
from kpirl_ocp.ocp.models.keypoint_costs import RBF, Default, KeypointCost, TimeDependent, Weighted
from kpirl_ocp.ocp.models.keypoint_dynamics import NetworkDynamics
from kpirl_ocp.ocp.models.keypoint_problems import keypoint_ocp, keypoint_state, network_ocp
from kpirl_ocp.ocp.models.mlp import MLP
from kpirl_ocp.ocp.models.onnx.load import load_onnx
from kpirl_ocp.ocp.models.robot import Keypoint, Robot
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.sensitivity.sensitivity import sensitivity
from kpirl_ocp.ocp.solvers.fatrop import Fatrop
from kpirl_ocp.ocp.solvers.gradient_descent import GradientDescent
from kpirl_ocp.ocp.solvers.ipopt import Ipopt
from kpirl_ocp.ocp.solvers.riccati import Riccati
from kpirl_ocp.ocp.solvers.sqp import SQP
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
    "identify",
    "keypoint_ocp",
    "keypoint_state",
    "learn",
    "load_dynamics",
    "load_onnx",
    "network_ocp",
    "sensitivity",
]
