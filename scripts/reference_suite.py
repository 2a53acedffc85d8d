"""Solve the classic problems of tests/reference with every solver, check gradients, learn; write a table (Markdown)."""

import sys
from pathlib import Path

from kpirl_ocp.cli.main import experiment
from kpirl_ocp.cli.parser import Parser

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))  # where the problems are


def add_options(parser: Parser) -> None:
    parser.add_argument("--only", nargs="+", metavar="NAME", help="problems (default: all)")


if __name__ == "__main__":
    experiment(str(__doc__), add_options, "experiments.reference_suite")
