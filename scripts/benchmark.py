"""Measure the fast core beside torch, JAX, plain CasADi, Fatrop and Ipopt, on one thread, and hold it against its bars.

Contenders take turns in one run. Writes benchmark.md, benchmark.png and metrics.json. JAX and torch are optional peers:
pip install .[bench]. The cache of compiled code is empty at the start, and does not touch the user's.
"""

import argparse
import os
import tempfile
import time
from pathlib import Path

from bench import one_thread  # noqa: F401  before anything that starts threads

# isort: split
from bench import (
    batches,
    ceilings,
    compile_times,
    control,
    drawing,
    export,
    growth,
    hypergradients,
    iiwa,
    implicit,
    machine,
    memory,
    real_time,
    solvers,
)
from bench.bars import bars, table
from bench.part import Table
from bench.settings import PRESETS

from kpirl_ocp.reporting import output_directory, run, write_metrics

PARTS = {
    "ceilings": ceilings.measure,
    "control": control.measure,
    "hypergradients": hypergradients.measure,
    "batches": batches.measure,
    "solvers": solvers.measure,
    "implicit": implicit.measure,
    "growth": growth.measure,
    "real_time": real_time.measure,
    "memory": memory.measure,
    "compile_times": compile_times.measure,
    "iiwa": iiwa.measure,
    "export": export.measure,
}


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", choices=list(PRESETS), default="full", help="how much (default: full)")
    parser.add_argument("--only", choices=list(PARTS), nargs="+", default=list(PARTS), help="parts (default: all)")
    parser.add_argument("--out", default="out/benchmark", help="directory to write (default: %(default)s)")
    return parser.parse_args()


def measure(names: list[str], preset: str) -> tuple[dict[str, dict], list[Table]]:
    """Numbers and tables of the parts, each shown as soon as it is done."""
    numbers: dict[str, dict] = {}
    tables: list[Table] = []
    for name in names:
        print(f"{name} ..", flush=True)
        started = time.perf_counter()
        part = PARTS[name](PRESETS[preset])
        numbers[name] = part.numbers
        tables += part.tables
        print("\n\n".join(map(str, part.tables)) + f"\n\n({time.perf_counter() - started:.0f} s)\n", flush=True)
    return numbers, tables


def main() -> None:
    args = parse()
    out, before = output_directory(args.out), machine.describe()
    with tempfile.TemporaryDirectory() as cache:
        os.environ["XDG_CACHE_HOME"] = cache
        numbers, tables = measure(args.only, args.preset)
    claims = bars(numbers)
    tables.append(table(claims))
    print(f"{tables[-1]}\n")

    after = machine.describe()["load"]
    if max(before["load"][0] - 1, after[0] - 2) > 0.5:
        print(
            f"The machine was busy (load {before['load'][0]:.1f} before, {after[0]:.1f} after): times are too long.\n"
        )
    settings = vars(args) | {"machine": before | {"load_after": after}}
    results = numbers | {"bars": [vars(bar) | {"verdict": bar.verdict} for bar in claims]}
    written = Path(out / "benchmark.md")
    written.write_text("\n\n".join(map(str, tables)) + "\n")
    print(f"tables:  {written}\nnumbers: {write_metrics(out, settings, results)}")
    print(f"figure:  {drawing.draw(numbers, claims, PRESETS[args.preset], out / 'benchmark.png')}")


if __name__ == "__main__":
    run(main)
