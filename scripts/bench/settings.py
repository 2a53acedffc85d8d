"""Sizes of the benchmark."""

from __future__ import annotations

from dataclasses import dataclass

from bench.contenders import NAMES, OURS
from bench.problem import random_network
from kpirl_ocp.irl.cases.network_cases import NetworkCase, placing_case
from kpirl_ocp.ocp.models import RBF, TimeDependent, Weighted
from kpirl_ocp.ocp.models.keypoint_costs import Basis


@dataclass(frozen=True)
class Preset:
    """Sizes and effort.

    hidden: widths of the network's hidden layers. steps: N and horizons: T of the grid of hypergradients.
    paper_steps, paper_horizon: N and T of the paper. long_steps: N at which unrolling should cost more than solving.
    demonstrations: how many are evaluated at once. starts: solved OCPs per model. growing: horizons for growth.
    control_steps: of the closed loop. qps: how many at once, qp_horizon: of each.
    exported: horizons of exported controllers. exported_steps: of their closed loop. optimisation: of their compiler.
    exported_control: optimisation of exported controllers among the control problems.
    counts: iterations at which memory is measured.
    remembered: contenders whose memory is measured. methods: of learn_cost.py whose compilation is timed.
    bases: of the keypoint costs on the iiwa. trained: measure the model that comes with the package, too.
    budget: seconds per contender and case. most: timed calls per contender and case at most.
    patience: a call that would take longer than this is left out [s].
    """

    hidden: tuple[int, ...] = (100, 25)
    steps: tuple[int, ...] = (1, 20, 100)
    horizons: tuple[int, ...] = (10, 25, 100, 400)
    paper_steps: int = 20
    paper_horizon: int = 25
    long_steps: int = 100
    demonstrations: int = 10
    starts: int = 2
    growing: tuple[int, ...] = (25, 100, 400)
    control_steps: int = 100
    qps: int = 128
    qp_horizon: int = 20
    exported: tuple[int, ...] = (10, 25)
    exported_steps: int = 10000
    optimisation: str = "-O3"
    exported_control: str = "-O1"
    counts: tuple[int, ...] = (10, 100, 1000)
    remembered: tuple[str, ...] = NAMES
    methods: tuple[str, ...] = ("unrolled", "implicit")
    bases: tuple[Basis, ...] = (Weighted(), TimeDependent(), RBF())
    trained: bool = True
    budget: float = 1.0
    most: int = 300
    patience: float = 5.0

    def models(self, *activations: str, steps: int | None = None, count: int = 1) -> list[NetworkCase]:
        """Random weights with these activations, and the trained model, at the paper's T; N by default the paper's."""
        horizon, steps = self.paper_horizon, steps or self.paper_steps
        found = [random_network(self.hidden, horizon, steps, name, count) for name in activations]
        return [*found, *([placing_case(horizon, steps, count)] if self.trained else [])]


PRESETS = {
    "full": Preset(),
    "tiny": Preset(
        hidden=(6, 4),
        steps=(2,),
        horizons=(3,),
        paper_steps=2,
        paper_horizon=3,
        long_steps=4,
        demonstrations=2,
        starts=1,
        growing=(2, 4),
        control_steps=3,
        qps=3,
        qp_horizon=4,
        exported=(2,),
        exported_steps=20,
        optimisation="-O0",
        exported_control="-O0",
        counts=(2,),
        remembered=(OURS,),
        methods=("unrolled",),
        bases=(Weighted(),),
        trained=False,
        budget=0.02,
        most=3,
        patience=1.0,
    ),
}
