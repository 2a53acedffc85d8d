"""The paper's simulation study: reaching and placing, several seeds, our methods against others.

And whether apprenticeship learning oscillates, for every choice that the paper leaves open.
A run that was stopped resumes where it was: every finished case is kept in --out.
"""

from pathlib import Path

from kpirl_ocp.cli.main import experiment
from kpirl_ocp.cli.parser import Parser
from kpirl_ocp.cli.values import MOST_DEMONSTRATIONS, MOST_PROCESSES, directory, one_of, whole

TASKS = ("reaching", "placing")


def add_options(parser: Parser) -> None:
    parser.add_argument("--tasks", type=one_of(TASKS), nargs="+", default=list(TASKS), help="default: both")
    parser.add_argument("--seeds", type=whole(0), nargs="+", default=[0, 1, 2], help="default: 0 1 2")
    parser.add_argument("--iterations", type=whole(1), default=100, help="outer iterations (default: 100)")
    parser.add_argument(
        "--tests", type=whole(1, MOST_DEMONSTRATIONS), default=5, help="test demonstrations (default: 5)"
    )
    parser.add_argument("--jobs", type=whole(1, MOST_PROCESSES), default=2, help="processes (default: 2)")
    parser.add_argument("--out", type=directory, default=Path("out/study"), help="directory (default: %(default)s)")


if __name__ == "__main__":
    experiment(str(__doc__), add_options, "reproduction.simulation_study")
