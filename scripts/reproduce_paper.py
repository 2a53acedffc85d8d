"""The paper's experiments from nothing: the simulation study, reaching, placing from a human video, and robustness.

Writes report.html and metrics.json. A run that was stopped resumes where it was: every finished part is kept in --out.
"""

from pathlib import Path

from kpirl_ocp.cli.main import experiment
from kpirl_ocp.cli.parser import Parser
from kpirl_ocp.cli.values import MOST_PROCESSES, directory, existing_directory, one_of, whole

PRESETS = ("full", "tiny")
BACKENDS = ("loky", "dask", "ray")


def add_options(parser: Parser) -> None:
    parser.add_argument("--preset", type=one_of(PRESETS), default="full", help=f"{' or '.join(PRESETS)} (the first)")
    parser.add_argument("--seeds", type=whole(0), nargs="+", help="default: 0 1 2; tiny: 0")
    parser.add_argument(
        "--models",
        type=existing_directory,
        help="directory of detector.json, reaching.json, placing.json (default: shipped)",
    )
    parser.add_argument("--jobs", type=whole(1, MOST_PROCESSES), default=2, help="processes (default: 2)")
    parser.add_argument(
        "--backend", type=one_of(BACKENDS), default="loky", help="loky (here, the default), dask or ray"
    )
    parser.add_argument("--address", help="of a running Dask scheduler or Ray cluster")
    parser.add_argument("--out", type=directory, default=Path("out/paper"), help="directory (default: %(default)s)")


if __name__ == "__main__":
    experiment(str(__doc__), add_options, "reproduction.paper")
