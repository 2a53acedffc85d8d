"""All parts of the stress test, and what broke."""

import subprocess
import sys
import time
from argparse import Namespace
from datetime import date
from pathlib import Path

from bench import one_thread  # noqa: F401  before anything that starts threads

# isort: split
from bench.part import Table

from kpirl_ocp.reporting import kept_if_interrupted, write_metrics
from stress import bars
from stress.certificates import contest
from stress.kills import campaign
from stress.lives import memory
from stress.peers import rates
from stress.settings import PROFILES
from stress.starts import board, minimum_time, obstacles, units
from stress.statuses import confirmed

PARTS = {
    "certificates": contest.measure,
    "peers": rates.measure,
    "statuses": confirmed.measure,
    "starts": board.measure,
    "units": units.measure,
    "obstacles": obstacles.measure,
    "times": minimum_time.measure,
    "lives": memory.measure,
    "kills": campaign.measure,
}


def _commit() -> str:
    words = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    return subprocess.run(words, capture_output=True, text=True, check=False).stdout.strip() or "unknown"


def main(args: Namespace) -> int:
    profile, numbers, tables = PROFILES[args.profile], dict[str, dict](), list[Table]()
    with kept_if_interrupted(args.out, vars(args), numbers, lambda: f"{len(numbers)} of {len(args.only)} parts"):
        for name in args.only:
            started = time.perf_counter()
            part = PARTS[name](profile)
            numbers[name] = part.numbers
            tables += part.tables
            print("\n\n".join(map(str, part.tables)) + f"\n\n({time.perf_counter() - started:.0f} s)\n", flush=True)
    broken = bars.broken(numbers)
    written = args.out / "stress.md"
    heading = f"{date.today()}, commit {_commit()}, profile `{args.profile}`"
    written.write_text("\n\n".join([heading, *map(str, tables)]) + "\n")
    print(f"tables:  {written}\nnumbers: {write_metrics(args.out, vars(args), numbers | {'broken': broken})}")
    print("".join(f"{line}\n" for line in broken), file=sys.stderr, end="")
    return int(bool(broken))
