"""Classic problems with every solver: iterations, gradients and learned parameters."""

from argparse import Namespace

import numpy as np
from reference import REFERENCES, Reference, coarse, gradient_error, learned, solve
from tqdm import tqdm

from kpirl_ocp import SQP, Fatrop, Ipopt, Riccati
from kpirl_ocp.episodes import write_whole
from kpirl_ocp.errors import CertificateError, OptionError, suggestion
from kpirl_ocp.reporting import said_if_interrupted

SOLVERS = (Riccati(1e-9), Ipopt(1e-9), Fatrop(1e-7), SQP())
HEADER = ("problem", "source", "T", "published", "found", "Riccati", "Ipopt", "Fatrop", "SQP", "gradient", "psi")
NOTE = """
Iterations of the solvers from the same guess, or the status of one that fails, and the objective of one that ends at
another optimum; Riccati's and Ipopt's tolerance is 1e-9. Actions are constant over a step: the difference to the
published value falls with the number of steps T. Published values are those of the source's own discretisation.

`gradient`: largest error of the certified implicit gradient of a linear loss by s0 and psi, relative to extrapolated
differences; `psi`: relative error of the parameters learned from one plan, starting at 1.2 psi. Both are of problems
with about 40 and 25 steps (see `coarse` in tests/reference/checks.py); a dash: there is no psi.

Made by `python scripts/reference_suite.py`.
"""


def verdicts(reference: Reference) -> tuple[float, list[str], float]:
    """Objective, a word for every solver, and the iterations of Riccati as a multiple of Ipopt's."""
    case = reference.build(reference.steps)
    plans = [solve(case, solver) for solver in SOLVERS]
    value, words = case.sign * plans[0].objective, []
    for plan in plans:
        other = case.sign * plan.objective
        elsewhere = "" if np.isclose(other, value, rtol=1e-5) else f" ({other:.6g})"
        words.append(f"{plan.iterations}{elsewhere}" if plan.status.ok else plan.status.name)
    both = plans[0].status.ok and plans[1].status.ok
    return value, words, plans[0].iterations / plans[1].iterations if both else np.nan


def checked(reference: Reference) -> list[str]:
    """The errors of the gradient and of learned parameters."""
    try:
        gradient = f"{gradient_error(coarse(reference)):.1e}"
    except CertificateError:
        gradient = "not certified"
    case = coarse(reference, most=25)
    return [gradient, f"{learned(case)[1]:.1e}" if case.psi.size else "-"]


def row(reference: Reference) -> tuple[list[str], float]:
    value, words, ratio = verdicts(reference)
    published = "-" if reference.optimum is None else f"{reference.optimum:.7g}"
    first = [reference.name, reference.source, str(reference.steps), published, f"{value:.7g}"]
    return [*first, *words, *checked(reference)], ratio


def summary(ratios: list[float]) -> str:
    """The geometric mean and the maximum of the ratios, as a sentence."""
    known = [ratio for ratio in ratios if np.isfinite(ratio)]
    if not known:
        return ""
    return (
        f"\nRiccati's iterations are {np.exp(np.mean(np.log(known))):.2f} times Ipopt's in the geometric mean of "
        f"{len(known)} problems, {max(known):.2f} times at most.\n"
    )


def chosen(names: list[str] | None) -> list[Reference]:
    """The problems of these names, or all. Raises OptionError if there is none of a name."""
    known = {reference.name: reference for reference in REFERENCES}
    for name in set(names or ()) - known.keys():
        raise OptionError(f"--only: there is no problem {name!r}{suggestion(name, known)}")
    return [reference for name, reference in known.items() if names is None or name in names]


def main(args: Namespace) -> None:
    lines, ratios = [" | ".join(HEADER), " | ".join(["---"] * len(HEADER))], []
    path, references = args.out / "reference_suite.md", chosen(args.only)
    with said_if_interrupted(lambda: f"{len(ratios)} of {len(references)} problems are in {path}"):
        for reference in tqdm(references, "reference suite"):
            words, ratio = row(reference)
            lines.append(" | ".join(words))
            ratios.append(ratio)
            print(lines[-1], flush=True)
            table = "".join(f"| {line} |\n" for line in lines)
            write_whole(path, f"# Reference suite\n\n{table}{summary(ratios)}{NOTE}")
    print(f"table: {path}")
