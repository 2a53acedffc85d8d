from .irl.hypergradients.finite_difference import FiniteDifference
from .irl.hypergradients.implicit import Implicit
from .irl.hypergradients.unrolled import Truncated, Unrolled
from .irl.identifiability.identify import identify
from .irl.learning.apprenticeship import apprenticeship
from .irl.learning.evaluation import evaluate
from .irl.learning.learn import learn
from .irl.learning.optimisers import LBFGS, Adam, Descent
from .ocp.models.dynamics_files import load_dynamics
from .ocp.models.keypoint_costs import RBF, Default, KeypointCost, TimeDependent, Weighted
from .ocp.models.keypoint_dynamics import NetworkDynamics
from .ocp.models.keypoint_problems import keypoint_ocp, keypoint_state, network_ocp
from .ocp.models.mlp import MLP
from .ocp.models.onnx.load import load_onnx
from .ocp.models.robot import Keypoint, Robot
from .ocp.problem.ocp import OCP
from .ocp.problem.statement.continuous import discretise
from .ocp.problem.statement.soft import Soft
from .ocp.sensitivity.sensitivity import sensitivity
from .ocp.solvers.fatrop import Fatrop
from .ocp.solvers.gradient_descent import GradientDescent
from .ocp.solvers.ipopt import Ipopt
from .ocp.solvers.riccati import Riccati
from .ocp.solvers.sqp import SQP
from .types import Demonstration, Solution, Status, Trajectory
from .version import __version__ as __version__

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
    "Soft",
    "Solution",
    "Status",
    "TimeDependent",
    "Trajectory",
    "Truncated",
    "Unrolled",
    "Weighted",
    "apprenticeship",
    "discretise",
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
