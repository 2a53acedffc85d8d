"""Sizes of the experiments: the numbers of the paper where it gives them, and our own for the rest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from kpirl_ocp.irl.visual.learning import InnerLoop

STARTS = (1, 2)
# The paper's inner loop: alpha of section 5, and one step, as in Equation 4 and Algorithm 3.
PAPER_LOOP = InnerLoop(1, 1e-3)
# Plain descent from the start of the authors' code: at the rate that Algorithm 1 prints, and at one with which it
# arrives within the iterations below. Rates depend on the unit of keypoints, which the paper does not give.
PAPER_START = 0.01
PRINTED_RATE = 1e-3
LARGER_RATE = 0.1


@dataclass(frozen=True)
class Preset:
    """Sizes of the experiments.

    demonstrations: how many to learn from in experiment 1. tests: held out. validation: demonstrations for the choice
        of the inner loop, of seeds of their own; one is learned from, the others judge, in turn.
    inner_loops: what the choice of "more steps" is among.
    *_iterations: outer iterations; reaching and placing: of Adam. study_*: of the simulation study.
    cases: random cases per condition of the robustness study. executions: of one cost, for the spread of Table 1.
    """

    demonstrations: tuple[int, ...] = (1, 10)
    tests: int = 5
    validation: int = 3
    inner_loops: tuple[InnerLoop, ...] = tuple(
        InnerLoop(steps, size) for size in (1e-4, 3e-4, 1e-3) for steps in (5, 10, 20)
    )
    reaching_iterations: int = 300  # 1000 did no better on validation demonstrations
    placing_iterations: int = 5000  # the paper's
    choice_iterations: int = 1000  # of Adam, placing: enough to compare inner loops
    descent_iterations: int = 5000  # of plain descent in placing
    reaching_descent_iterations: int = 1000
    implicit_iterations: int = 300  # a cap; L-BFGS ends before where it can
    baseline_iterations: int = 100
    study_iterations: int = 100
    study_tests: int = 5
    cases: int = 20
    executions: int = 5


PRESETS: Mapping[str, Preset] = {
    "tiny": Preset(
        demonstrations=(1, 2),
        tests=1,
        validation=2,
        inner_loops=(InnerLoop(1, 3e-4), InnerLoop(2, 3e-4)),
        reaching_iterations=5,
        placing_iterations=10,
        choice_iterations=5,
        descent_iterations=5,
        reaching_descent_iterations=5,
        implicit_iterations=1,
        baseline_iterations=3,
        study_iterations=3,
        study_tests=1,
        cases=1,
        executions=2,
    ),
    "full": Preset(),
}
