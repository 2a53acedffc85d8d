"""The paper's experiments from nothing: the simulation study, reaching, placing from a human video, and robustness.

Writes report.html and metrics.json. A run that was stopped goes on where it was: every finished part is kept in --out.
"""

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from reproduction import (
    axes,
    background,
    data,
    learning,
    placing,
    reaching,
    repeated,
    report,
    robustness,
    simulation,
)
from reproduction.data import Data, Models
from reproduction.outcome import Outcome, claims
from reproduction.page import Page
from reproduction.settings import PRESETS, Preset
from reproduction.sweep import BACKENDS, Job, Result, backend, run_sweep

from kpirl_ocp.irl.visual.demonstrations import robot_demonstration
from kpirl_ocp.irl.visual.learning import InnerLoop
from kpirl_ocp.reporting import output_directory, run, write_metrics


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", choices=list(PRESETS), default="full", help="how much (default: full)")
    parser.add_argument("--seeds", type=int, nargs="+", help="default: 0 1 2; tiny: 0")
    parser.add_argument("--models", help="directory of detector.json, reaching.json, placing.json (default: shipped)")
    parser.add_argument("--jobs", type=int, default=2, help="processes (default: 2)")
    parser.add_argument("--backend", choices=BACKENDS, default="loky", help="where they run (default: loky, here)")
    parser.add_argument("--address", help="of a running Dask scheduler or Ray cluster")
    parser.add_argument("--out", default="out/paper", help="directory to write (default: %(default)s)")
    return parser.parse_args()


class Stages:
    """Runs the sweeps one after another and remembers all results."""

    def __init__(self, out: Path, workers: int) -> None:
        self.results: dict[str, Result] = {}
        self._directory, self._workers = out / "results", workers

    def __call__(self, title: str, jobs: Sequence[Job]) -> dict[str, Result]:
        """Run one stage."""
        found = run_sweep(title, jobs, self._directory, self._workers)
        self.results |= found
        return found


def experiments(models: Models, material: Data, preset: Preset, seeds: Sequence[int], stage: Stages) -> Outcome:
    """Every stage in turn; a later one uses what an earlier one has chosen or learned."""
    stage("1/6 simulation study", simulation.jobs(preset, seeds))

    dynamics = models.load_dynamics("reaching")
    validation = {
        "reaching": [robot_demonstration(dynamics, track) for track in material.reaching_validation],
        "placing": [
            placing.set_up(models, clip, 1000 + index).demonstration
            for index, clip in enumerate(material.placing_validation)
        ],
    }
    iterations = {"reaching": preset.reaching_iterations, "placing": preset.placing_iterations}
    candidates = [
        job
        for task, demos in validation.items()
        for job in learning.choice_jobs(task, models, demos, preset.inner_loops, iterations[task])
    ]
    judged = stage("2/6 choice of inner loop", candidates)
    tried = {task: learning.tried(judged, task, preset.inner_loops) for task in validation}
    chosen = {task: learning.choose(task, found) for task, found in tried.items()}

    found = placing.setups(models, material.placing, seeds)
    learned = stage(
        "3/6 learning",
        [
            *reaching.jobs(models, material.reaching, chosen["reaching"], preset, seeds),
            *placing.jobs(models, found, chosen["placing"], preset),
            *with_background(models, material, found, chosen, preset, seeds[0]),
        ],
    )
    stage(
        "4/6 reaching, executed",
        [
            *reaching.execution_jobs(models, material.reaching, learned, preset, seeds[0]),
            *axes.jobs(models, material.reaching, learned, preset, seeds),
        ],
    )
    stage(
        "5/6 placing, executed",
        [
            *placing.execution_jobs(models, found, learned),
            *repeated.jobs(models, found, learned, preset.executions, seeds[0]),
        ],
    )
    stage("6/6 robustness", robustness.jobs(models, found, learned, preset.cases))
    stage.results |= {f"demonstration-{seed}": placing.shown(material.placing, seed) for seed in seeds}
    return Outcome(preset, seeds, chosen, tried, stage.results)


def with_background(
    models: Models,
    material: Data,
    found: dict[int, placing.Setup],
    chosen: dict[str, InnerLoop],
    preset: Preset,
    seed: int,
) -> list[Job]:
    """Both tasks with a keypoint in the background."""
    dynamics = models.load_dynamics("reaching")
    train = [robot_demonstration(dynamics, track) for track in material.reaching[: max(preset.demonstrations)]]
    demonstrations = {"reaching": train, "placing": [found[seed].demonstration]}
    adam = {"reaching": preset.reaching_iterations, "placing": preset.placing_iterations}
    jobs = []
    for task in background.TASKS:
        counts = {c: reaching.iterations_of(c, adam[task], preset) for c in background.CONTENDERS}
        jobs += background.jobs(task, models, demonstrations[task], chosen[task], counts, seed)
    return jobs


def main() -> None:
    args = parse()
    preset = PRESETS[args.preset]
    seeds = args.seeds or ([0] if args.preset == "tiny" else [0, 1, 2])
    out = output_directory(args.out)
    models = Models.find(args.models)
    sizes = (max(preset.demonstrations) + preset.tests, preset.validation, len(seeds))
    material = data.prepare(out / "data", models, *sizes, workers=args.jobs)
    with backend(args.backend, args.address, args.jobs):
        outcome = experiments(models, material, preset, seeds, Stages(out, args.jobs))

    settings = vars(args) | {"seeds": seeds, "preset": asdict(preset), "models": asdict(models)}
    settings |= {"inner_loops": {task: asdict(loop) for task, loop in outcome.chosen.items()}}
    page = Page("Model-Based Inverse Reinforcement Learning from Visual Demonstrations, reproduced")
    report.write(page, outcome, settings)
    for claim in claims(outcome):
        print(f"[{'holds' if claim.holds else 'does NOT hold'}] {claim.text}\n    {claim.numbers}")
    kept = {name: {k: v for k, v in found.items() if k != "images"} for name, found in outcome.results.items()}
    results = {"claims": [asdict(claim) for claim in claims(outcome)], "jobs": kept}
    print(f"\nnumbers: {write_metrics(out, settings, results)}")
    print(f"report:  {page.write(out / 'report.html')}")


if __name__ == "__main__":
    run(main)
