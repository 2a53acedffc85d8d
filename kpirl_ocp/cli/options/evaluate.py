"""Plan with a learned cost on new demonstrations; compare it with the Default cost and with standing still."""

from argparse import ArgumentParser
from pathlib import Path

from kpirl_ocp.cli.values import existing_directory, existing_file


def add_options(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--cost",
        type=existing_file,
        default=Path("out/learn/cost.json"),
        help="cost.json of `kpirl learn` (default: %(default)s)",
    )
    parser.add_argument(
        "--demonstrations",
        type=existing_directory,
        required=True,
        metavar="DIR",
        help="directory from `kpirl demonstrate`",
    )
