"""Compare the hypergradients on a problem of choice: error, time, memory and certificate over N, and learning curves.

The constraints of the problem are left out, so that gradient descent can take part. The reference is the implicit
gradient at a solution to 1e-12, checked against finite differences.
"""

import argparse
from dataclasses import asdict
from pathlib import Path

from experiments.comparison import Measurement, learn_with_each, measure_all, methods, reference
from tqdm import tqdm

from kpirl_ocp import figures
from kpirl_ocp.irl.cases.examples import CASES, unconstrained
from kpirl_ocp.irl.learning.result import LearningResult
from kpirl_ocp.reporting import output_directory, run, table, write_metrics


def as_row(measurement: Measurement, resolution: float) -> list[object]:
    """Cells for a table; an error below `resolution`, to which the reference is known, is shown as that."""
    return [
        measurement.method,
        measurement.steps or "-",
        f"{measurement.error:.1e}" if measurement.error > resolution else f"< {resolution:.1e}",
        f"{1e3 * measurement.seconds:.3f}",
        f"{measurement.memory / 2**20:.1f}",
        measurement.certificate.split(":")[0],
    ]


def draw(measurements: list[Measurement], learning: dict[str, LearningResult], resolution: float, path: Path) -> Path:
    """`resolution`: the relative error to which the reference is known; smaller errors are drawn there."""
    figure, axes = figures.new_figure(2, 2, width=5.0, height=3.6)
    names = list(dict.fromkeys(m.method for m in measurements))
    quantities = [("error", 1, "relative error"), ("seconds", 1e3, "time per gradient [ms]")]
    quantities += [("memory", 2**-20, "peak memory, building included [MB]")]
    for axis, (field, factor, label) in zip(axes, quantities, strict=False):
        for colour, name in zip(figures.COLOURS, names, strict=False):
            floor = resolution if field == "error" else 0.0
            points = [(m.steps, max(floor, factor * getattr(m, field))) for m in measurements if m.method == name]
            if points[0][0]:
                axis.plot(*zip(*points, strict=True), ".-", color=colour, label=name)
            else:
                axis.axhline(points[0][1], color=colour, linestyle="--", label=name)
        axis.set(xscale="log", yscale="log", xlabel="inner gradient steps N", ylabel=label)
    axes[0].legend(fontsize=7)
    for colour, (name, result) in zip(figures.COLOURS, learning.items(), strict=False):
        axes[3].plot(result.seconds[1:], result.losses[1:], color=colour, label=name)
    axes[3].set(xscale="log", yscale="log", xlabel="wall time [s]", ylabel="IRL loss, with its own inner loop")
    axes[3].legend(fontsize=7)
    for axis in axes:
        axis.grid(alpha=0.3, which="both")
    return figures.save(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problem", choices=list(CASES), default="iiwa", help="an example problem (default: iiwa)")
    parser.add_argument("--steps", type=int, nargs="+", default=[1, 3, 10, 30, 100, 300, 1000], help="values of N")
    parser.add_argument("--iterations", type=int, default=100, help="outer iterations of learning (default: 100)")
    parser.add_argument("--learning-rate", type=float, default=3e-2, help="of Adam (default: 0.03)")
    parser.add_argument("--out", default="out/compare_hypergradients", help="directory (default: %(default)s)")
    args = parser.parse_args()

    case = unconstrained(CASES[args.problem]())
    exact, agreement = reference(case)
    print(f"{args.problem}: {len(exact)} parameters; finite differences agree with the reference to {agreement:.1e}")
    with tqdm(total=len(list(methods(case, args.steps))), desc="measuring", unit="method") as bar:
        measurements = measure_all(args.problem, args.steps, lambda _: bar.update() and None)
    header = ["method", "N", "relative error", "time [ms]", "memory [MB]", "certificate"]
    print("\n" + table(header, [as_row(m, agreement) for m in measurements]) + "\n")

    some = [n for n in args.steps if n in (min(args.steps), max(args.steps), args.steps[len(args.steps) // 2])]
    learning = learn_with_each(args.problem, some, args.iterations, args.learning_rate)
    rows = [[name, r.losses[0], r.loss, f"{r.seconds[-1]:.2f}"] for name, r in learning.items()]
    print(table(["learning with", "first IRL loss", "best IRL loss", "time [s]"], rows))

    out = output_directory(args.out)
    results = {
        "reference": exact,
        "finite_difference_agreement": agreement,
        "measurements": [asdict(m) for m in measurements],
        "learning": {name: {"losses": r.losses, "seconds": r.seconds} for name, r in learning.items()},
    }
    print(f"\nnumbers: {write_metrics(out, vars(args), results)}")
    print(f"figure:  {draw(measurements, learning, agreement, out / 'hypergradients.png')}")


if __name__ == "__main__":
    run(main)
