"""All parts of the benchmark, and the bars."""

import os
import tempfile
import time
from argparse import Namespace

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
    page,
    qps,
    real_time,
    solvers,
)
from bench.bars import bars, table
from bench.part import Table
from bench.settings import PRESETS
from kpirl_ocp.reporting import kept_if_interrupted, write_metrics

PARTS = {
    "ceilings": ceilings.measure,
    "control": control.measure,
    "hypergradients": hypergradients.measure,
    "batches": batches.measure,
    "solvers": solvers.measure,
    "implicit": implicit.measure,
    "qps": qps.measure,
    "growth": growth.measure,
    "real_time": real_time.measure,
    "memory": memory.measure,
    "compile_times": compile_times.measure,
    "iiwa": iiwa.measure,
    "export": export.measure,
}


def measure(names: list[str], preset: str, numbers: dict[str, dict]) -> dict[str, list[Table]]:
    """Tables of the parts, each shown as soon as it is done; their numbers go into `numbers`."""
    tables: dict[str, list[Table]] = {}
    for name in names:
        print(f"{name} ..", flush=True)
        started = time.perf_counter()
        part = PARTS[name](PRESETS[preset])
        numbers[name] = part.numbers
        tables[name] = list(part.tables)
        print("\n\n".join(map(str, part.tables)) + f"\n\n({time.perf_counter() - started:.0f} s)\n", flush=True)
    return tables


def main(args: Namespace) -> None:
    before, numbers = machine.describe(), dict[str, dict]()
    with (
        tempfile.TemporaryDirectory() as cache,
        kept_if_interrupted(args.out, vars(args), numbers, lambda: f"{len(numbers)} of {len(args.only)} parts"),
    ):
        os.environ["XDG_CACHE_HOME"] = cache
        tables = measure(args.only, args.preset, numbers)
    claims = bars(numbers)
    verdicts = table(claims)
    print(f"{verdicts}\n")

    after = machine.describe()["load"]
    if max(before["load"][0] - 1, after[0] - 2) > 0.5:
        print(
            f"The machine was busy (load {before['load'][0]:.1f} before, {after[0]:.1f} after): times are too long.\n"
        )
    settings = vars(args) | {"machine": before | {"load_after": after}}
    results = numbers | {"bars": [vars(bar) | {"verdict": bar.verdict} for bar in claims]}
    written = args.out / "benchmark.md"
    every = [*(one for part in tables.values() for one in part), verdicts]
    written.write_text("\n\n".join(map(str, every)) + "\n")
    print(f"tables:  {written}\nnumbers: {write_metrics(args.out, settings, results)}")
    figure = drawing.draw(numbers, PRESETS[args.preset], args.out / "benchmark.png")
    print(f"figure:  {figure}")
    if args.page:
        page.write(tables, verdicts, numbers, figure)
        print(f"page:    {page.PAGE}")
