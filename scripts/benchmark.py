"""Compare the fast core with torch, JAX, plain CasADi, Fatrop and Ipopt, on one thread, and with its targets.

Contenders take turns in one run, which takes a quarter of an hour. Writes benchmark.md, benchmark.png and metrics.json;
with --page the pages that show them, too. JAX, torch, PIQP and Crocoddyl are optional peers: pip install .[bench]. The
cache of compiled code is empty at the start, and does not touch the user's.
A part that fails is named at the end, with the numbers of all others kept and no page written.
"""

from kpirl_ocp.cli.main import experiment
from kpirl_ocp.cli.parser import Parser
from kpirl_ocp.cli.values import one_of

PRESETS = ("full", "tiny")
PARTS = (
    *("ceilings", "control", "hypergradients", "batches", "solvers", "implicit", "qps"),
    *("growth", "real_time", "memory", "compile_times", "iiwa", "export"),
)


def add_options(parser: Parser) -> None:
    parser.add_argument("--preset", type=one_of(PRESETS), default="full", help=f"{' or '.join(PRESETS)} (the first)")
    parser.add_argument(
        "--only", type=one_of(PARTS), nargs="+", default=list(PARTS), metavar="PART", help=f"some of {', '.join(PARTS)}"
    )
    parser.add_argument(
        "--page", action="store_true", help="write docs/results/benchmark.md, its figure and the README's table as well"
    )


if __name__ == "__main__":
    experiment(str(__doc__), add_options, "bench.suite")
