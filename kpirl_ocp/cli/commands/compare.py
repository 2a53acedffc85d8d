"""Compare the hypergradients on a problem: error, time, memory and certificate over N, and learning curves."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import asdict
from pathlib import Path

import numpy as np
from tqdm import tqdm

from kpirl_ocp import figures
from kpirl_ocp.cli.options.compare import PROBLEMS
from kpirl_ocp.errors import OptionError
from kpirl_ocp.irl.learning.comparison import Measurement, case_of, learn_with_each, measure_all, methods, reference
from kpirl_ocp.irl.learning.result import LearningResult
from kpirl_ocp.reporting import kept_if_interrupted, table, write_metrics


def as_row(measurement: Measurement, resolution: float) -> list[object]:
    """Cells of a table. resolution: the relative error of the reference; smaller errors are shown as '< resolution'."""
    return [
        measurement.method,
        measurement.steps or "-",
        f"{measurement.error:.1e}" if measurement.error > resolution else f"< {resolution:.1e}",
        f"{1e3 * measurement.seconds:.3f}",
        f"{measurement.memory / 2**20:.1f}",
        measurement.certificate.split(":")[0],
    ]


def draw(measurements: list[Measurement], learning: dict[str, LearningResult], resolution: float, path: Path) -> Path:
    """The figure. resolution: the relative error of the reference; smaller errors are drawn there."""
    figure, axes = figures.new_figure(2, 2, width=5.0, height=3.6)
    colours = dict(zip(dict.fromkeys(m.method for m in measurements), figures.COLOURS, strict=False))
    quantities = [("error", 1, "relative error"), ("seconds", 1e3, "CPU time per gradient [ms]")]
    quantities += [("memory", 2**-20, "peak memory, building included [MB]")]
    for axis, (field, factor, label) in zip(axes, quantities, strict=False):
        for name, colour in colours.items():
            floor = resolution if field == "error" else 0.0
            points = [(m.steps, max(floor, factor * getattr(m, field))) for m in measurements if m.method == name]
            if points[0][0]:
                axis.plot(*zip(*points, strict=True), ".-", color=colour, label=name)
            else:
                axis.axhline(points[0][1], color=colour, linestyle="--", label=name)
        axis.set(xscale="log", yscale="log", xlabel="inner gradient steps N", ylabel=label)
    axes[0].legend(fontsize=7)
    for name, result in learning.items():
        same = [other for other in learning if other.split(",")[0] == name.split(",")[0]]  # a method has one colour
        shade = np.linspace(0.35, 1.0, len(same))[same.index(name)] if len(same) > 1 else 1.0
        axes[3].plot(result.seconds[1:], result.losses[1:], color=colours[name.split(",")[0]], alpha=shade, label=name)
    axes[3].set(xscale="log", yscale="log", xlabel="CPU time [s]", ylabel="IRL loss, with its own inner loop")
    axes[3].legend(fontsize=7)
    for axis in axes:
        axis.grid(alpha=0.3, which="both")
    return figures.save(figure, path)


def main(args: Namespace) -> None:
    """Measure, learn with each, draw."""
    if args.own and args.problem:
        raise OptionError("--problem is an example, and FILE.py:FUNCTION your own: give one of them")
    source = args.own or args.problem or PROBLEMS[0]
    case = case_of(source)
    exact, agreement = reference(case)
    print(f"{source}: {len(exact)} parameters; finite differences agree with the reference to {agreement:.1e}")
    results = {"reference": exact, "finite_difference_agreement": agreement, "step_size": case.step_size}
    measurements: list[Measurement] = []
    steps = sorted(set(args.steps))
    total = len(list(methods(case, steps)))
    with kept_if_interrupted(args.out, vars(args), results, lambda: f"{len(measurements)} of {total} measurements"):
        for measurement in tqdm(measure_all(source, steps, exact), "measuring", total, unit="method"):
            measurements.append(measurement)
            results["measurements"] = [asdict(m) for m in measurements]
        header = ["method", "N", "relative error", "CPU time [ms]", "memory [MB]", "certificate"]
        print("\n" + table(header, [as_row(m, agreement) for m in measurements]) + "\n")

        some = sorted({steps[0], steps[len(steps) // 2], steps[-1]})
        learning = learn_with_each(case, some, args.iterations, args.learning_rate)
    rows = [[name, r.losses[0], r.loss, f"{r.seconds[-1]:.2f}"] for name, r in learning.items()]
    print(table(["learning with", "first IRL loss", "best IRL loss", "CPU time [s]"], rows))
    results["learning"] = {name: {"losses": r.losses, "seconds": r.seconds} for name, r in learning.items()}
    print(f"\nnumbers: {write_metrics(args.out, vars(args), results)}")
    print(f"figure:  {draw(measurements, learning, agreement, args.out / 'hypergradients.png')}")
