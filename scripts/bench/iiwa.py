"""One gradient step of IRL on the iiwa placing problem with ground-truth keypoints: T = 9, three keypoints."""

from __future__ import annotations

import time

from bench.part import Part, Table
from bench.settings import Preset
from bench.timing import interleaved
from kpirl_ocp import GradientDescent, Implicit, Riccati, Unrolled
from kpirl_ocp.irl.cases.tasks import HORIZON, as_demonstration, demonstrate
from kpirl_ocp.irl.hypergradients.certificate import Hypergradient
from kpirl_ocp.ocp.models import KeypointCost, Robot, keypoint_ocp


def measure(preset: Preset) -> Part:
    """Loss, gradient and certificate for each cost of the paper, unrolled over N, and implicit."""
    robot = Robot.iiwa()
    demonstration = as_demonstration(robot, demonstrate(robot, "placing", 1, seed=0)[0])
    calls, first = {}, {}
    for basis in preset.bases:
        for steps in (*preset.steps, 0):
            method: Hypergradient = Unrolled(GradientDescent(steps, 1e-3)) if steps else Implicit(Riccati())
            cost = KeypointCost(basis, effort=0.0 if steps else 10.0)
            problem = keypoint_ocp(robot, cost, HORIZON).unconstrained()
            psi = cost.initial(HORIZON, problem.n_observations)
            name = f"{type(basis).__name__}, " + (f"unrolled, N = {steps}" if steps else "implicit (Riccati)")
            calls[name] = lambda method=method, inputs=(problem, demonstration, psi): method(*inputs)
            started = time.perf_counter()
            calls[name]()
            first[name] = time.perf_counter() - started
    timings = interleaved(calls, preset.budget / 4, preset.most)
    numbers = {name: {**timing.numbers, "first_call_s": first[name]} for name, timing in timings.items()}
    rows = [[name, timing, f"{first[name]:.2f}"] for name, timing in timings.items()]
    title = f"iiwa with ground-truth keypoints, placing, T = {HORIZON}"
    return Part(numbers, [Table(title, ["loss, gradient and certificate", "time [ms]", "first call [s]"], rows)])
