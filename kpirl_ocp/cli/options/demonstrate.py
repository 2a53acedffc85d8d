"""Make demonstrations of a task on the iiwa and write them as episode files.

The first episode is for training, the others are for testing; each has its own start and goal.
"""

from argparse import ArgumentParser

from kpirl_ocp.cli.options.learn import TASKS
from kpirl_ocp.cli.values import MOST_DEMONSTRATIONS, one_of, whole
from kpirl_ocp.sizes import LONGEST


def add_options(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--task", type=one_of(TASKS), default="placing", help="placing (default) or reaching")
    parser.add_argument(
        "--tests", type=whole(0, MOST_DEMONSTRATIONS), default=5, help="number of test demonstrations (default: 5)"
    )
    parser.add_argument("--horizon", type=whole(1, LONGEST), default=9, help="time steps T (default: 9)")
    parser.add_argument("--seed", type=whole(0), default=0, help="for starts and goals (default: 0)")
