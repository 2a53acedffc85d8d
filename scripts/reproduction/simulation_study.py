"""The simulation study by itself: its jobs, tables and figure."""

import itertools
from argparse import Namespace
from dataclasses import asdict
from pathlib import Path

import numpy as np
from experiments.apprenticeship_variants import HEADER, Variant, rows_of
from experiments.study import DRAWN, METHODS, Curve, StudySettings

from kpirl_ocp import figures
from kpirl_ocp.irl.cases.tasks import TASKS
from kpirl_ocp.reporting import said_if_interrupted, spread, table, write_metrics
from reproduction.simulation import curve_of, job_of, variants_of
from reproduction.sweep import run_sweep, with_joblib
from reproduction.tables import restlessness

Results = dict[tuple[str, int], dict[str, Curve]]
Variants = dict[tuple[str, int], dict[str, Variant]]


def run_all(args: Namespace, settings: StudySettings) -> tuple[Results, Variants]:
    """Curves and variants of every case; finished cases are read."""
    cases = list(itertools.product(args.tasks, args.seeds))
    todo = [job_of(task, seed, settings) for task, seed in cases]
    found = run_sweep("simulation study", todo, args.out / "results", with_joblib(args.jobs))
    by_case = dict(zip(cases, found.values(), strict=True))
    curves = {case: {name: curve_of(result, name) for name in METHODS} for case, result in by_case.items()}
    return curves, {case: variants_of(result) for case, result in by_case.items()}


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
        rises = restlessness([curve.train for curve in curves])
        spreads = (spread(values) for values in (train, test, distance))
        seconds = np.mean([curve.seconds for curve in curves])
        rows.append([f"{task}: {method}", *spreads, f"{100 * rises:.0f} %", f"{seconds:.2f}"])
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


def main(args: Namespace) -> None:
    settings = StudySettings(iterations=args.iterations, tests=args.tests)
    with said_if_interrupted(lambda: f"finished cases are in {args.out}; the same command resumes"):
        results, variants = run_all(args, settings)
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
    print(f"\nnumbers: {write_metrics(args.out, vars(args) | asdict(settings), metrics)}")
    print(f"figure:  {draw(results, args.out / 'study.png')}")
