"""Plan with a solver, and show the solution's own audit.

Without FILE.py:FUNCTION an arm moves its keypoints to a goal: their starting place displaced by --move, in metres.
Try: --robot panda --solver ipopt --move 0.1 0 -0.2

With FILE.py:FUNCTION the problem is yours. The function takes no arguments and returns an OCP and its numbers:

    def pendulum():
        ...
        return OCP.from_expressions(...), {"s0": [0, 0], "psi": [0.8, 0.02]}

s0 is the initial state; psi (the parameters) and context (a goal, say) are needed where the problem has them.
"""

from argparse import ArgumentParser

from kpirl_ocp.cli.values import name, one_of, own_function, real, whole
from kpirl_ocp.sizes import LONGEST

SOLVERS = ("riccati", "ipopt", "fatrop", "sqp", "gradient")
ARM = {
    "robot": "iiwa",
    "move": [0.1, 0.0, -0.2],
    "horizon": 10,
    "effort": 0.1,
    "max_displacement": 0.2,
    "tool": None,
    "rerun": False,
}


def add_options(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("problem", nargs="?", type=own_function, metavar="FILE.py:FUNCTION", help="your own problem")
    parser.add_argument("--solver", type=one_of(SOLVERS), default="riccati", help=f"{', '.join(SOLVERS)} (the first)")
    parser.add_argument(
        "--steps", type=whole(1, LONGEST), default=500, help="steps of the gradient solver (default: 500)"
    )
    parser.add_argument(
        "--step-size", type=real(above=0), default=3e-3, help="step size of the gradient solver (default: 0.003)"
    )
    arm = parser.add_argument_group("the arm's problem")
    arm.add_argument(
        "--robot", type=name, help="iiwa (default), a name of example-robot-data (panda, ur5), or a .urdf file"
    )
    arm.add_argument("--tool", type=name, metavar="LINK", help="link that holds the object (default: the arm's tool)")
    move = real(least=-1000, most=1000)
    arm.add_argument(
        "--move",
        type=move,
        nargs=3,
        metavar=("DX", "DY", "DZ"),
        help="displacement of the goal [m] (default: 0.1 0 -0.2)",
    )
    arm.add_argument("--horizon", type=whole(1, LONGEST), help="time steps T (default: 10)")
    arm.add_argument("--effort", type=real(least=0), help="weight rho of |u|² (default: 0.1)")
    arm.add_argument(
        "--max-displacement", type=real(above=0), help="largest |u| per joint and step [rad] (default: 0.2)"
    )
    arm.add_argument("--rerun", action="store_true", default=None, help="write plan.rrd as well, for the Rerun viewer")
