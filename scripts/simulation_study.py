"""The paper's simulation study: reaching and placing, several seeds, our methods against others.

And whether apprenticeship learning oscillates, for every choice that the paper leaves open.
"""

import argparse
import itertools
from dataclasses import asdict
from pathlib import Path

import joblib
import numpy as np
from experiments.apprenticeship_variants import HEADER, Variant, rows_of, run_variants
from experiments.study import DRAWN, METHODS, Case, Curve, StudySettings, run_case
from tqdm import tqdm

from kpirl_ocp import figures
from kpirl_ocp.irl.cases.tasks import TASKS, write_demonstrations
from kpirl_ocp.ocp.models import Robot
from kpirl_ocp.reporting import output_directory, run, spread, table, write_metrics

Results = dict[tuple[str, int], dict[str, Curve]]
Variants = dict[tuple[str, int], dict[str, Variant]]


def run_one(directory: Path, seed: int, settings: StudySettings) -> tuple[dict[str, Curve], dict[str, Variant]]:
    case = Case.read(directory, seed, settings)
    return run_case(case), run_variants(case)


def run_all(cases: list[tuple[str, int]], settings: StudySettings, jobs: int, out: Path) -> tuple[Results, Variants]:
    """Demonstrate every case into out/demonstrations, then run each in a process of its own, `jobs` at a time."""
    directories = [out / "demonstrations" / f"{task}-{seed}" for task, seed in cases]
    for directory, (task, seed) in zip(directories, cases, strict=True):
        write_demonstrations(directory, Robot.iiwa(), task, settings.tests, seed, settings.horizon)
    found = joblib.Parallel(jobs, return_as="generator")(
        joblib.delayed(run_one)(directory, seed, settings)
        for directory, (_, seed) in zip(directories, cases, strict=True)
    )
    both = dict(zip(cases, tqdm(found, total=len(cases), desc="study", unit="case"), strict=True))
    return {case: curves for case, (curves, _) in both.items()}, {
        case: variants for case, (_, variants) in both.items()
    }


def summary(results: Results) -> list[list[object]]:
    """Mean and spread over seeds, at the psi with the lowest training loss, and how restless training was."""
    rows: list[list[object]] = []
    for task, method in itertools.product(TASKS, METHODS):
        curves = [case[method] for (name, _), case in results.items() if name == task]
        if not curves:
            continue
        test, distance, train = (
            np.array([getattr(c, field)[c.best] for c in curves]) for field in ("test", "distance", "train")
        )
        rises = [np.mean(np.diff(c.train) > 0.01 * c.train[:-1]) if len(c.train) > 1 else 0.0 for c in curves]
        spreads = (spread(values) for values in (train, test, distance))
        seconds = np.mean([curve.seconds for curve in curves])
        rows.append([f"{task}: {method}", *spreads, f"{100 * np.mean(rises):.0f} %", f"{seconds:.2f}"])
    return rows


def draw(results: Results, path: Path) -> Path:
    tasks = [task for task in TASKS if any(name == task for name, _ in results)]
    figure, axes = figures.new_figure(2, len(tasks), width=5.0, height=3.4)
    panels = {}
    for field in ("train", "test"):
        for task in tasks:
            cases = [case for (name, _), case in results.items() if name == task]
            longest = max(len(getattr(curve, field)) for case in cases for curve in case.values())
            curves = {method: [getattr(case[method], field) for case in cases] for method in (*DRAWN, "default")}
            curves["default"] = [np.full(longest, run[0]) for run in curves["default"]]
            what = "training demonstration" if field == "train" else "test demonstrations"
            panels[f"{task}: {what}"] = curves
    figures.panels_of_bands(axes, panels, "IRL loss [m²]")
    return figures.save(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=list(TASKS), default=list(TASKS), help="default: both")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="default: 0 1 2")
    parser.add_argument("--iterations", type=int, default=100, help="outer iterations (default: 100)")
    parser.add_argument("--tests", type=int, default=5, help="test demonstrations (default: 5)")
    parser.add_argument("--jobs", type=int, default=2, help="processes (default: 2)")
    parser.add_argument("--out", default="out/study", help="directory to write (default: %(default)s)")
    args = parser.parse_args()

    settings = StudySettings(iterations=args.iterations, tests=args.tests)
    out = output_directory(args.out)
    results, variants = run_all(list(itertools.product(args.tasks, args.seeds)), settings, args.jobs, out)
    header = ["task: method", "train IRL loss [m²]", "test IRL loss [m²]", "relative distance", "rises", "time [s]"]
    print("\n" + table(header, summary(results)))
    print("Mean ± standard deviation over seeds, at the psi with the lowest training loss.")
    print("rises: share of outer iterations in which the training loss went up by more than 1 %.")

    by_task = {task: [run for (name, _), run in variants.items() if name == task] for task in args.tasks}
    print("\n" + table(HEADER, rows_of(by_task)))
    print("late swings: share of the last half of the epochs in which the training loss rises by more than a tenth.")

    curves = {f"{t}, seed {s}": {m: asdict(c) for m, c in case.items()} for (t, s), case in results.items()}
    choices = {f"{t}, seed {s}": {n: asdict(v) for n, v in run.items()} for (t, s), run in variants.items()}
    metrics = {"methods": curves, "apprenticeship": choices}
    print(f"\nnumbers: {write_metrics(out, vars(args) | asdict(settings), metrics)}")
    print(f"figure:  {draw(results, out / 'study.png')}")


if __name__ == "__main__":
    run(main)
