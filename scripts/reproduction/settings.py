"""Sizes of the experiments: the numbers of the paper where it gives them, and our own for the rest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from kpirl_ocp.irl.visual.learning import InnerLoop

STARTS = (1, 2)
# The paper's inner loop: alpha of section 5, and N of the authors' code, which the paper does not state.
PAPER_LOOP = InnerLoop(1, 1e-3)


@dataclass(frozen=True)
class Preset:
    """Sizes of the experiments.

    demonstrations: how many to learn from in experiment 1. tests: held out. validation: demonstrations for the choice
        of the inner loop, of seeds of their own; one is learned from, the others judge, in turn.
    inner_loops: what the choice of "more steps" is among.
    *_iterations: outer iterations. study_*: of the simulation study.
    cases: random cases per condition of the robustness study.
    """

    demonstrations: tuple[int, ...] = (1, 10)
    tests: int = 5
    validation: int = 3
    inner_loops: tuple[InnerLoop, ...] = tuple(
        InnerLoop(steps, size) for size in (1e-4, 3e-4, 1e-3) for steps in (5, 10, 20)
    )
    reaching_iterations: int = 300  # 1000 did no better on validation demonstrations
    placing_iterations: int = 5000  # the paper's
    implicit_iterations: int = 30
    baseline_iterations: int = 100
    study_iterations: int = 100
    study_tests: int = 5
    cases: int = 20


PRESETS: Mapping[str, Preset] = {
    "tiny": Preset(
        demonstrations=(1, 2),
        tests=2,
        validation=2,
        inner_loops=(InnerLoop(1, 3e-4), InnerLoop(5, 3e-4)),
        reaching_iterations=5,
        placing_iterations=10,
        implicit_iterations=1,
        baseline_iterations=3,
        study_iterations=3,
        study_tests=1,
        cases=1,
    ),
    "full": Preset(),
}
