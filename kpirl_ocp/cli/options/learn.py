"""Learn a cost from demonstrations, plan with it on those kept for testing, and show what was learned.

unrolled: the paper's method; N gradient steps on the actions are differentiated.
implicit: the planning problem is solved to convergence by Riccati, and its optimality conditions are differentiated.

Ctrl-C keeps the best cost so far; the same command resumes from there.
"""

from argparse import ArgumentParser

from kpirl_ocp.cli.values import MOST_DEMONSTRATIONS, existing_directory, one_of, real, whole
from kpirl_ocp.sizes import LONGEST

TASKS = ("placing", "reaching")
METHODS = ("unrolled", "implicit")
COSTS = ("weighted", "time", "rbf")
OPTIMISERS = ("adam", "descent", "lbfgs")


def add_options(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--demonstrations", type=existing_directory, metavar="DIR", help="directory from `kpirl demonstrate`"
    )
    parser.add_argument("--task", type=one_of(TASKS), help=f"or make new ones of {' or '.join(TASKS)} (the first)")
    parser.add_argument(
        "--train",
        type=whole(1, MOST_DEMONSTRATIONS),
        default=1,
        help="learn from the first so many demonstrations (default: 1)",
    )
    parser.add_argument("--method", type=one_of(METHODS), default="unrolled", help="unrolled (default) or implicit")
    parser.add_argument("--cost", type=one_of(COSTS), default="weighted", help="weighted (default), time or rbf")
    parser.add_argument("--iterations", type=whole(0), default=100, help="of the optimiser, at most (default: 100)")
    parser.add_argument(
        "--optimiser", type=one_of(OPTIMISERS), help="adam (default if unrolled), lbfgs (default if implicit), descent"
    )
    parser.add_argument("--learning-rate", type=real(above=0), default=1e-2, help="of adam and descent (default: 0.01)")
    parser.add_argument(
        "--inner-steps", type=whole(1, LONGEST), default=5, help="N of the unrolled method (default: 5)"
    )
    parser.add_argument(
        "--step-size", type=real(above=0), default=1e-2, help="alpha of the unrolled method (default: 0.01)"
    )
    parser.add_argument("--seed", type=whole(0), default=0, help="for demonstrations and initial weights (default: 0)")
