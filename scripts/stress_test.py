"""Try to break the package, and write the tables: certificates, peers, statuses, starts, long lives, kills.

The certificate contest generates cases whose hypergradient, or lack of one, is known without the package; no wrong
one may be certified. Peers answer the same cases. Solvers' statuses are confirmed independently. `Riccati` and Ipopt
start from the same noise, in the same odd units, between the same obstacles, and cold towards a free final time. One
process solves very often, and very many problems. Long work is killed at random moments and started again until it has
ended.
"""

import sys
from pathlib import Path

from kpirl_ocp.cli.main import experiment
from kpirl_ocp.cli.parser import Parser
from kpirl_ocp.cli.values import directory, one_of

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))  # where cases are
PROFILES = ("full", "quick")
PARTS = ("certificates", "peers", "statuses", "starts", "units", "obstacles", "times", "lives", "kills")


def add_options(parser: Parser) -> None:
    parser.add_argument("--profile", type=one_of(PROFILES), default="full", help=f"{' or '.join(PROFILES)} (the first)")
    parser.add_argument(
        "--only", type=one_of(PARTS), nargs="+", default=list(PARTS), metavar="PART", help=f"some of {', '.join(PARTS)}"
    )
    parser.add_argument("--out", type=directory, default=Path("out/stress"), help="directory (default: %(default)s)")


if __name__ == "__main__":
    experiment(str(__doc__), add_options, "stress.suite")
