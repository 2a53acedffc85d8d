"""What is no problem, no number or not installed is refused in a sentence; what was started is ended."""

import subprocess
import sys

import numpy as np
import pytest
from statements import state

from kpirl_ocp import SQP, Demonstration, Fatrop, GradientDescent, Ipopt, Riccati, sensitivity
from kpirl_ocp.errors import ProblemError

SOLVERS = [Riccati(), Ipopt(), Fatrop(), SQP(), GradientDescent(steps=2, step_size=0.1)]


@pytest.mark.parametrize("solver", SOLVERS, ids=lambda solver: type(solver).__name__)
def test_arguments_in_another_order_are_refused(solver):
    with pytest.raises(ProblemError, match=r"problem must be an OCP, got \[0.0, 0.0\]: solve\("):
        solver.solve([0.0, 0.0], state())


def test_a_derivative_of_arguments_in_another_order_is_refused():
    problem = state()
    with pytest.raises(ProblemError, match="an OCP and the solution of it are needed, in this order"):
        sensitivity(Riccati().solve(problem, [0.0, 0.0]), problem)


def test_masked_entries_are_not_read_as_numbers():
    """Under the mask are numbers, such as -999, or what was there before."""
    hidden = np.ma.masked_greater(np.tile([0.0, 2.0], (13, 1)), 1.0)
    with pytest.raises(ProblemError, match=r"the demonstration's observations .* 13 of them masked: fill them"):
        Demonstration([0.0, 0.0], [], hidden)
    with pytest.raises(ProblemError, match="s0 must be an array of numbers; 1 of them masked"):
        Riccati().solve(state(), hidden[0])
    assert Demonstration([0.0, 0.0], [], np.ma.masked_greater(np.zeros((13, 2)), 1.0)).horizon == 12


def test_the_process_of_fatrop_ends_before_python_does():
    """With -W error, Python names processes and files that are still open at its end."""
    code = """
import casadi as ca
from kpirl_ocp import OCP, Fatrop
s, u = ca.SX.sym("s"), ca.SX.sym("u")
problem = OCP.from_expressions(state=s, action=u, dynamics=s + u, stage_cost=s**2 + u**2, horizon=3)
print(Fatrop().solve(problem, [1.0]).status.name)
"""
    run = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True)
    assert (run.stdout.split(), run.stderr) == (["CONVERGED"], "")


@pytest.mark.parametrize(
    ("room", "name", "package", "extra"),
    [
        ("bridges", "OCPLayer", "torch", "torch"),
        ("bridges", "from_torch", "torch", "torch"),
        ("bridges", "ocp_function", "jax", "jax"),
        ("perception.detector", "KeypointDetector", "torch", "perception"),
        ("perception.dynamics", "train_dynamics", "torch", "perception"),
        ("perception.tracking", "follow_object", "cv2", "perception"),
        ("perception.data", "write_video", "av", "perception"),
        ("viewing", "show_arm", "viser", "viewer"),
    ],
)
def test_a_name_that_needs_an_extra_says_which(room, name, package, extra):
    code = f"""
import sys
sys.modules[{package!r}] = None
try:
    from kpirl_ocp.{room} import {name}
except ImportError as error:
    print(type(error).__name__, error)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    expected = f'{name} needs {package}, which is not installed: pip install "kpirl-ocp[{extra}]".'
    assert run.stdout == f"DependencyError {expected}\n"
