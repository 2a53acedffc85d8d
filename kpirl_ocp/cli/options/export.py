"""Export a model-predictive controller as a folder of C99 that needs nothing but libc and libm.

By default: the placing model that comes with the package, with action bounds and joint limits; the weights of the
keypoints and the goal are given at run time. With --cost: the planner of a learned cost, on the iiwa's kinematics.

With FILE.py:FUNCTION the problem is yours. The function takes no arguments and returns an OCP and its numbers, s0, psi
and context as for `kpirl solve`; they become the recorded example that the folder tests itself with.
"""

from argparse import ArgumentParser, ArgumentTypeError

from kpirl_ocp.cli.values import existing_file, one_of, own_function, whole
from kpirl_ocp.sizes import LONGEST

SOLVERS = ("real-time", "converged", "gradient-descent", "sqp")


def prefix(word: str) -> str:
    """A lower-case name in C."""
    if not (word.isascii() and word.isidentifier() and word == word.lower()):
        raise ArgumentTypeError(f"expected a prefix of lower-case letters, digits and underscores, got {word!r}")
    return word


def add_options(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("problem", nargs="?", type=own_function, metavar="FILE.py:FUNCTION", help="your own problem")
    parser.add_argument("--cost", type=existing_file, metavar="FILE", help="or a cost.json of `kpirl learn`")
    parser.add_argument("--solver", type=one_of(SOLVERS), help=f"{', '.join(SOLVERS)} (the first, or that of --cost)")
    parser.add_argument("--horizon", type=whole(1, LONGEST), help="T of the placing model (default: 10)")
    parser.add_argument(
        "--prefix", type=prefix, default="kpirl_mpc", help="of all names and files (default: %(default)s)"
    )
    parser.add_argument("--seed", type=whole(0), default=0, help="for the recorded examples (default: 0)")
