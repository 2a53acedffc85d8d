"""Compare the hypergradients on a problem: error, time, memory and certificate over N, and learning curves.

The constraints of the problem are left out, because gradient descent does not handle them. The reference is the
implicit gradient at a solution to 1e-12, checked against finite differences.

With FILE.py:FUNCTION the problem is yours. The function takes no arguments and returns an OCP and its numbers: s0, psi
and context as for `kpirl solve`, and the observations (T+1, n) of a demonstration. Without a step_size for gradient
descent among them, it is estimated from the curvature at the solution.
"""

from argparse import ArgumentParser

from kpirl_ocp.cli.values import one_of, own_function, real, whole
from kpirl_ocp.sizes import LONGEST

PROBLEMS = ("iiwa", "integrator", "lqr", "pendulum")


def add_options(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("own", nargs="?", type=own_function, metavar="FILE.py:FUNCTION", help="your own problem")
    parser.add_argument("--problem", type=one_of(PROBLEMS), help=f"or an example: {', '.join(PROBLEMS)} (the first)")
    parser.add_argument(
        "--steps",
        type=whole(1, LONGEST),
        nargs="+",
        default=[1, 3, 10, 30, 100, 300, 1000],
        metavar="N",
        help="numbers N of inner gradient steps",
    )
    parser.add_argument("--iterations", type=whole(1), default=100, help="outer iterations of learning (default: 100)")
    parser.add_argument("--learning-rate", type=real(above=0), default=3e-2, help="of Adam (default: 0.03)")
