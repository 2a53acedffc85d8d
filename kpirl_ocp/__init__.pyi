from .errors import CertificateError, KpirlError
from .irl.hypergradients.finite_difference import FiniteDifference
from .irl.hypergradients.implicit import Implicit
from .irl.hypergradients.unrolled import Truncated, Unrolled
from .irl.learning.evaluation import evaluate
from .irl.learning.learn import learn
from .irl.learning.optimisers import LBFGS, Adam, Descent
from .ocp.export.exported_solver import ExportedSolver
from .ocp.export.folder import export_c
from .ocp.problem.ocp import OCP
from .ocp.problem.statement.continuous import discretise
from .ocp.problem.statement.soft import Soft
from .ocp.sensitivity.solution_sensitivity import sensitivity
from .ocp.solvers.fatrop import Fatrop
from .ocp.solvers.gradient_descent import GradientDescent
from .ocp.solvers.ipopt import Ipopt
from .ocp.solvers.riccati import Riccati
from .ocp.solvers.sqp import SQP
from .types import Demonstration, Solution, Status, Trajectory
from .version import __version__ as __version__

__all__ = [
    "LBFGS",
    "OCP",
    "SQP",
    "Adam",
    "CertificateError",
    "Demonstration",
    "Descent",
    "ExportedSolver",
    "Fatrop",
    "FiniteDifference",
    "GradientDescent",
    "Implicit",
    "Ipopt",
    "KpirlError",
    "Riccati",
    "Soft",
    "Solution",
    "Status",
    "Trajectory",
    "Truncated",
    "Unrolled",
    "discretise",
    "evaluate",
    "export_c",
    "learn",
    "sensitivity",
]
