"""Measure the fast core beside torch, JAX, plain CasADi, Fatrop and Ipopt, on one thread, and hold it against its bars.

Contenders take turns in one run. Writes benchmark.md, benchmark.png and metrics.json. JAX and torch are optional peers:
pip install .[bench]. The cache of compiled code is empty at the start, and does not touch the user's.
"""

from kpirl_ocp.cli.main import experiment
from kpirl_ocp.cli.parser import Parser
from kpirl_ocp.cli.values import one_of

PRESETS = ("full", "tiny")
PARTS = (
    *("ceilings", "control", "hypergradients", "batches", "solvers", "implicit"),
    *("growth", "real_time", "memory", "compile_times", "iiwa", "export"),
)


def add_options(parser: Parser) -> None:
    parser.add_argument("--preset", type=one_of(PRESETS), default="full", help=f"{' or '.join(PRESETS)} (the first)")
    parser.add_argument(
        "--only", type=one_of(PARTS), nargs="+", default=list(PARTS), metavar="PART", help=f"some of {', '.join(PARTS)}"
    )


if __name__ == "__main__":
    experiment(str(__doc__), add_options, "bench.suite")
