"""Solve the classic problems of tests/reference with Riccati and Ipopt, and write the table as Markdown."""

import argparse
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from reference.problems import REFERENCES, Instance, Reference

from kpirl_ocp import Ipopt, Riccati
from kpirl_ocp.reporting import run

HEADER = ("problem", "source", "T", "published", "found", "Riccati: iterations", "ms", "Ipopt: iterations", "ms")
NOTE = (
    "From the same guess, to a tolerance of 1e-9. Actions are constant over a step: the difference to the published "
    "value falls with the number of steps T. Times are of one warm solve of each problem, Riccati without a compiler."
)


def measure(solver: Riccati | Ipopt, case: Instance) -> tuple[float, str, str]:
    """Objective, iterations (or the status of a failure), and the time of a second solve [ms]."""
    solver.solve(case.problem, case.s0, guess=case.guess)
    started = time.perf_counter()
    found = solver.solve(case.problem, case.s0, guess=case.guess)
    elapsed = 1e3 * (time.perf_counter() - started)
    word = str(found.iterations) if found.status.ok else found.status.name
    return case.sign * found.objective, word, f"{elapsed:.1f}"


def row(reference: Reference) -> list[str]:
    case = reference.build(reference.steps)
    value, *ours = measure(Riccati(tolerance=1e-9, compile=False), case)
    _, *peer = measure(Ipopt(tolerance=1e-9), case)
    numbers = [str(reference.steps), f"{reference.optimum:.7g}", f"{value:.7g}"]
    return [reference.name, reference.source, *numbers, *ours, *peer]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", default="out/reference_suite.md", help="file to write (default: %(default)s)")
    args = parser.parse_args()
    lines = [" | ".join(HEADER), " | ".join(["---"] * len(HEADER))]
    for reference in REFERENCES:
        lines.append(" | ".join(row(reference)))
        print(lines[-1], flush=True)
    path = Path(args.out)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("# Reference suite\n\n" + "".join(f"| {line} |\n" for line in lines) + f"\n{NOTE}\n")
    print(f"table: {path}")


if __name__ == "__main__":
    run(main)
