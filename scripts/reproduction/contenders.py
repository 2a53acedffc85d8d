"""The contenders of the experiments: families of costs, each with the methods that learn it."""

from __future__ import annotations

from dataclasses import dataclass

from kpirl_ocp.irl.visual.learning import COSTS, InnerLoop
from reproduction.settings import PAPER_LOOP, Preset


@dataclass(frozen=True)
class Contender:
    """A cost family and a method to learn it."""

    cost: str
    method: str

    @property
    def label(self) -> str:
        """Name in tables and figures."""
        method, *rest = self.method.split(", ")
        first = {"unrolled": self.cost, "implicit": f"{self.cost}, converged"}.get(method, method.capitalize())
        return ", ".join([first, *rest])

    def inner_loop(self, chosen: InnerLoop) -> InnerLoop:
        """The paper's, or the one that was chosen; it also sets the effort of the converged problem."""
        return chosen if "more steps" in self.method or "implicit" in self.method else PAPER_LOOP


def in_a_name(label: str) -> str:
    """The label as a part of a job's name: dashes for commas and spaces."""
    return label.replace(", ", "-").replace(" ", "-")


UNROLLED = tuple(Contender(cost, "unrolled") for cost in COSTS)
LITERAL = tuple(Contender(cost, "unrolled, to the letter") for cost in COSTS)
SMALL_START = tuple(Contender(cost, "unrolled, small start") for cost in COSTS)
MORE_STEPS = tuple(Contender(cost, "unrolled, more steps") for cost in COSTS)
APPRENTICE = Contender("Weighted", "apprenticeship")
DEFAULT = Contender("Weighted", "default")  # has nothing to learn
DEFAULT_MORE_STEPS = Contender("Weighted", "default, more steps")
IMPLICIT = tuple(Contender(cost, "implicit") for cost in COSTS)
EFFORT = (  # a single step from u = 0 knows no effort
    Contender("Weighted", "unrolled, more steps, effort learned"),
    Contender("Weighted", "implicit, effort learned"),
    Contender("Weighted", "implicit, effort per step"),
)

TABLE_1 = (*UNROLLED, *LITERAL, DEFAULT, *MORE_STEPS, DEFAULT_MORE_STEPS)
PLACING = (*UNROLLED, *LITERAL, *SMALL_START, DEFAULT, *MORE_STEPS, DEFAULT_MORE_STEPS, *IMPLICIT, *EFFORT)
REACHING_EXECUTED = (*UNROLLED, *LITERAL, APPRENTICE, DEFAULT, *MORE_STEPS, DEFAULT_MORE_STEPS)
REACHING = (*REACHING_EXECUTED, *SMALL_START, *IMPLICIT, *EFFORT)


def iterations_of(contender: Contender, adam: int, descent: int, preset: Preset) -> int:
    """Outer iterations: `adam` for contenders that use Adam, `descent` for those of plain descent."""
    if contender in (*LITERAL, *SMALL_START):
        return descent
    if contender.method.startswith("implicit"):
        return preset.implicit_iterations
    return preset.baseline_iterations if contender.method == "apprenticeship" else adam
