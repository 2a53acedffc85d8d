"""All parts of the benchmark, and the bars."""

import os
import tempfile
import time
import traceback
from argparse import Namespace
from collections.abc import Callable
from functools import partial
from pathlib import Path

from bench import one_thread  # before anything that starts threads

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
from kpirl_ocp.errors import KpirlError
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


def measure(
    names: list[str], preset: str, numbers: dict[str, dict], keep: Callable[[], object]
) -> dict[str, list[Table]]:
    """Tables of the parts, each shown and kept as soon as it is done; their numbers go into `numbers`.

    A part that fails is left out, and the others go on: `failures` names it.
    """
    tables: dict[str, list[Table]] = {}
    for name in names:
        print(f"{name} ..", flush=True)
        started = time.perf_counter()
        try:
            part = PARTS[name](PRESETS[preset])
        except Exception:  # of a peer or of ours
            traceback.print_exc()
            continue
        numbers[name] = part.numbers
        tables[name] = list(part.tables)
        keep()
        print("\n\n".join(map(str, part.tables)) + f"\n\n({time.perf_counter() - started:.0f} s)\n", flush=True)
    return tables


def failures(names: list[str], tables: dict[str, list[Table]], where: Path) -> None:
    """Raise KpirlError, which names the parts that failed, if there are any."""
    failed = [name for name in names if name not in tables]
    if failed:
        kept = f"what {', '.join(tables)} measured is in {where}" if tables else "nothing was measured"
        raise KpirlError(f"{', '.join(failed)} failed, for reasons above; {kept}.")


def main(args: Namespace) -> None:
    one_thread.on_one_core()
    before, numbers = machine.describe(), dict[str, dict]()
    with (
        tempfile.TemporaryDirectory() as cache,
        kept_if_interrupted(args.out, vars(args), numbers, lambda: f"{len(numbers)} of {len(args.only)} parts"),
    ):
        os.environ["XDG_CACHE_HOME"] = cache
        keep = partial(write_metrics, args.out, vars(args), numbers)
        tables = measure(args.only, args.preset, numbers, keep)
    if not tables:
        failures(args.only, tables, args.out)
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
    failures(args.only, tables, args.out)
    if args.page:
        page.write(tables, verdicts, numbers, figure)
        print(f"page:    {page.PAGE}")
