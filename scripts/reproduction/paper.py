"""All stages of the reproduction, one after another, and its report."""

from argparse import Namespace
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from kpirl_ocp.cli.sentences import of_option
from kpirl_ocp.errors import OptionError
from kpirl_ocp.irl.visual.demonstrations import robot_demonstration
from kpirl_ocp.irl.visual.learning import InnerLoop
from kpirl_ocp.reporting import said_if_interrupted, write_metrics
from reproduction import (
    axes,
    background,
    choice,
    data,
    placing,
    reaching,
    repeated,
    report,
    robustness,
    simulation,
)
from reproduction.contenders import iterations_of
from reproduction.data import Data, Models
from reproduction.outcome import Outcome, claims
from reproduction.page import Page
from reproduction.settings import PRESETS, Preset
from reproduction.sweep import Job, Result, Runner, backend, check_address, run_sweep


class Stages:
    """Runs the sweeps one after another and remembers all results."""

    def __init__(self, out: Path, runner: Runner) -> None:
        self.results: dict[str, Result] = {}
        self._directory, self._run = out / "results", runner

    def __call__(self, title: str, jobs: Sequence[Job]) -> dict[str, Result]:
        """Run one stage."""
        found = run_sweep(title, jobs, self._directory, self._run)
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
    iterations = {"reaching": preset.reaching_iterations, "placing": preset.choice_iterations}
    candidates = [
        job
        for task, demos in validation.items()
        for job in choice.jobs(task, models, demos, preset.inner_loops, iterations[task])
    ]
    judged = stage("2/6 choice of inner loop", candidates)
    tried = {task: choice.tried(judged, task, preset.inner_loops) for task in validation}
    chosen = {task: choice.choose(task, found) for task, found in tried.items()}

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
    outer = {
        "reaching": (preset.reaching_iterations, preset.reaching_descent_iterations),
        "placing": (preset.placing_iterations, preset.descent_iterations),
    }
    jobs = []
    for task in background.TASKS:
        counts = {c: iterations_of(c, *outer[task], preset) for c in background.CONTENDERS}
        jobs += background.jobs(task, models, demonstrations[task], chosen[task], counts, seed)
    return jobs


def main(args: Namespace) -> None:
    if args.address and args.backend == "loky":
        raise OptionError("--address is for --backend dask or ray; loky runs on this machine")
    check(args)
    with said_if_interrupted(lambda: f"finished parts are in {args.out}; the same command resumes"):
        reproduce(args)


def check(args: Namespace) -> None:
    """Raise OptionError for models that cannot be read, or for a cluster that does not answer."""
    with of_option("--models"):
        models = Models.find(args.models)
        models.load_detector()
        for task in ("reaching", "placing"):
            models.load_dynamics(task)
    if args.address not in (None, "auto"):
        check_address(args.address)
    if args.address:
        with of_option("--address"), backend(args.backend, args.address, args.jobs):
            pass


def reproduce(args: Namespace) -> None:
    """All experiments, then claims, numbers and report."""
    preset, out = PRESETS[args.preset], args.out
    seeds = args.seeds or ([0] if args.preset == "tiny" else [0, 1, 2])
    models = Models.find(args.models)
    sizes = (max(preset.demonstrations) + preset.tests, preset.validation, len(seeds))
    with backend(args.backend, args.address, args.jobs) as runner:  # a wrong address is said before data are made
        material = data.prepare(out / "data", models, *sizes, workers=args.jobs)
        outcome = experiments(models, material, preset, seeds, Stages(out, runner))

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
