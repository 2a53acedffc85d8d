"""Time one gradient step of IRL on the iiwa placing problem: loss and gradient, T = 9, three keypoints, one core.

Medians over repeats, with the spread from the 10th to the 90th percentile.
"""

import argparse
import os
import time

import numpy as np

from kpirl_ocp import (
    RBF,
    GradientDescent,
    Implicit,
    KeypointCost,
    Robot,
    TimeDependent,
    Unrolled,
    Weighted,
    figures,
    keypoint_ocp,
)
from kpirl_ocp.irl.hypergradient import Hypergradient
from kpirl_ocp.irl.tasks import as_demonstration, demonstrate
from kpirl_ocp.reporting import output_directory, run, table, write_metrics


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=300, help="timed calls per row (default: 300)")
    parser.add_argument("--out", default="out/benchmark", help="directory to write (default: %(default)s)")
    args = parser.parse_args()

    robot = Robot.iiwa()
    demonstration = as_demonstration(robot, demonstrate(robot, "placing", 1, seed=0)[0])
    rows: list[list[object]] = []
    results = {}
    for basis in (Weighted(), TimeDependent(), RBF()):
        for steps in (1, 5, 20, 100, 0):
            method: Hypergradient = Unrolled(GradientDescent(steps, 1e-3)) if steps else Implicit()
            cost = KeypointCost(basis, effort=0.0 if steps else 10.0)
            problem = keypoint_ocp(robot, cost, 9).unconstrained()
            psi = cost.initial(9, problem.n_observations)
            name = f"{type(basis).__name__}, " + (f"unrolled, N = {steps}" if steps else "implicit (Ipopt)")
            started = time.perf_counter()
            method(problem, demonstration, psi)
            first = time.perf_counter() - started
            times = []
            for _ in range(args.repeats):
                started = time.perf_counter()
                method(problem, demonstration, psi)
                times.append(time.perf_counter() - started)
            low, middle, high = 1e3 * np.percentile(times, [10, 50, 90])
            rows.append([name, f"{middle:.3f}", f"{low:.3f} - {high:.3f}", f"{first:.2f}"])
            results[name] = {"median_ms": middle, "p10_ms": low, "p90_ms": high, "first_call_s": first}
    print(table(["loss, gradient and certificate", "median [ms]", "10 - 90 % [ms]", "first call [s]"], rows))

    out = output_directory(args.out)
    figure, (axis,) = figures.new_figure(1, 1, width=7.5, height=4.0)
    low, middle, high = (np.array([r[key] for r in results.values()]) for key in ("p10_ms", "median_ms", "p90_ms"))
    axis.errorbar(middle, list(results), xerr=[middle - low, high - middle], fmt="o", color=figures.COLOURS[0])
    axis.set(xscale="log", xlabel="time per loss and gradient [ms], median and 10 - 90 %, one core")
    axis.grid(alpha=0.3, which="both", axis="x")
    axis.invert_yaxis()
    settings = vars(args) | {"OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "unset")}
    print(f"\nnumbers: {write_metrics(out, settings, results)}\nfigure:  {figures.save(figure, out / 'benchmark.png')}")


if __name__ == "__main__":
    run(main)
