"""The problem class, the interfaces of models and solvers, and the order of a problem's unknowns."""

from kpirl_ocp.ocp.problem.constraints import BoundRows, Inequalities
from kpirl_ocp.ocp.problem.dynamics import DynamicsDerivatives
from kpirl_ocp.ocp.problem.linearised_dynamics import LinearisedDynamics
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.reduced_cost import ReducedCost
from kpirl_ocp.ocp.problem.solver import BarrierSolver, Guess, LinearisingSolver, Solver
from kpirl_ocp.ocp.problem.statement.checks import Bounds
from kpirl_ocp.ocp.problem.statement.continuous import discretise
from kpirl_ocp.ocp.problem.statement.draft import Additions
from kpirl_ocp.ocp.problem.statement.soft import Soft
from kpirl_ocp.ocp.problem.trajectory_cost import TrajectoryCost
from kpirl_ocp.ocp.problem.trajectory_passes import TrajectoryPasses

__all__ = [
    "OCP",
    "Additions",
    "BarrierSolver",
    "BoundRows",
    "Bounds",
    "DynamicsDerivatives",
    "Guess",
    "Inequalities",
    "LinearisedDynamics",
    "LinearisingSolver",
    "ReducedCost",
    "Soft",
    "Solver",
    "TrajectoryCost",
    "TrajectoryPasses",
    "discretise",
]
