"""Plan with a learned cost on demonstrations it was not trained on, beside the Default cost and standing still."""

from argparse import ArgumentParser
from pathlib import Path

from kpirl_ocp.cli.values import existing_directory, existing_file


def add_options(parser: ArgumentParser) -> None:
    """Declare them."""
    parser.add_argument(
        "--cost", type=existing_file, default=Path("out/learn/cost.json"), help="of `kpirl learn` (%(default)s)"
    )
    parser.add_argument(
        "--demonstrations", type=existing_directory, required=True, metavar="DIR", help="from `kpirl demonstrate`"
    )
