"""The solvers, one small file each; all of them have the interface `Solver` of `problem`."""

from kpirl_ocp.ocp.solvers.fatrop import Fatrop
from kpirl_ocp.ocp.solvers.gradient_descent import GradientDescent
from kpirl_ocp.ocp.solvers.ipopt import Ipopt
from kpirl_ocp.ocp.solvers.many import pull_many, solve_many
from kpirl_ocp.ocp.solvers.riccati import Riccati
from kpirl_ocp.ocp.solvers.sqp import SQP

__all__ = ["SQP", "Fatrop", "GradientDescent", "Ipopt", "Riccati", "pull_many", "solve_many"]
