"""Try to break the package, and write the tables: certificates, peers, statuses, long lives of a process, kills.

The certificate contest generates cases whose hypergradient, or lack of one, is known without the package; no wrong one
may be certified. Peers answer the same cases. Solvers' statuses are confirmed independently. One process solves very
often, and very many problems. Long work is killed at random moments and started again until it has ended.
"""

import argparse
import subprocess
import sys
import time
from datetime import date
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from bench import one_thread  # noqa: F401  before anything that starts threads

# isort: split
from bench.part import Table
from stress import bars
from stress.certificates import contest
from stress.kills import campaign
from stress.lives import memory
from stress.peers import rates
from stress.settings import PROFILES
from stress.statuses import confirmed

from kpirl_ocp.reporting import output_directory, run, write_metrics

PARTS = {
    "certificates": contest.measure,
    "peers": rates.measure,
    "statuses": confirmed.measure,
    "lives": memory.measure,
    "kills": campaign.measure,
}


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--profile", choices=list(PROFILES), default="full", help="how much (default: full)")
    parser.add_argument("--only", choices=list(PARTS), nargs="+", default=list(PARTS), help="parts (default: all)")
    parser.add_argument("--out", default="out/stress", help="directory to write (default: %(default)s)")
    return parser.parse_args()


def _commit() -> str:
    words = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    return subprocess.run(words, capture_output=True, text=True, check=False).stdout.strip() or "unknown"


def main() -> None:
    args = parse()
    out, profile = output_directory(args.out), PROFILES[args.profile]
    numbers: dict[str, dict] = {}
    tables: list[Table] = []
    for name in args.only:
        started = time.perf_counter()
        part = PARTS[name](profile)
        numbers[name] = part.numbers
        tables += part.tables
        print("\n\n".join(map(str, part.tables)) + f"\n\n({time.perf_counter() - started:.0f} s)\n", flush=True)
    broken = bars.broken(numbers)
    written = out / "stress.md"
    heading = f"{date.today()}, commit {_commit()}, profile `{args.profile}`"
    written.write_text("\n\n".join([heading, *map(str, tables)]) + "\n")
    print(f"tables:  {written}\nnumbers: {write_metrics(out, vars(args), numbers | {'broken': broken})}")
    if broken:
        sys.exit("\n".join(broken))


if __name__ == "__main__":
    run(main)
