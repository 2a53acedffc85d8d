"""Watch a person place a bottle, learn what mattered, plan, and do it with the simulated arm.

The detector and the dynamics come with the package; the person's video, the arm's start and the initial weights differ
with --seed. Writes a picture, a short video and the learned weights. Needs the extra `perception`.
"""

from argparse import ArgumentParser

from kpirl_ocp.cli.values import one_of, whole

COSTS = ("TimeDep", "Weighted", "RBF")


def add_options(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--cost", type=one_of(COSTS), default="TimeDep", help=f"{', '.join(COSTS)} (the first)")
    parser.add_argument("--iterations", type=whole(1), default=2000, help="outer iterations (default: 2000)")
    parser.add_argument(
        "--seed", type=whole(0), default=0, help="for the person, the start and the weights (default: 0)"
    )
