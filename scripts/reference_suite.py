"""Solve the classic problems of tests/reference with every solver, check gradients, learn; write a table (Markdown)."""

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from reference import REFERENCES, Reference, coarse, gradient_error, learned, solve

from kpirl_ocp import SQP, Fatrop, Ipopt, Riccati
from kpirl_ocp.errors import CertificateError
from kpirl_ocp.reporting import run

SOLVERS = (Riccati(1e-9), Ipopt(1e-9), Fatrop(1e-7), SQP())
HEADER = ("problem", "source", "T", "published", "found", "Riccati", "Ipopt", "Fatrop", "SQP", "gradient", "psi")
NOTE = """
Iterations of the solvers from the same guess, or the status of one that fails, and the objective of one that ends at
another optimum; Riccati's and Ipopt's tolerance is 1e-9. Actions are constant over a step: the difference to the
published value falls with the number of steps T. Published values are those of the source's own discretisation.

`gradient`: largest error of the certified implicit gradient of a linear loss by s0 and psi, relative to extrapolated
differences; `psi`: relative error of the parameters learned from one plan, starting at 1.2 psi. Both are of problems
with about 40 and 25 steps (see `coarse` in tests/reference/checks.py); a dash: there is no psi.

Made by `python scripts/reference_suite.py --out docs/results/reference_suite.md`.
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", default="out/reference_suite.md", help="file to write (default: %(default)s)")
    names = [reference.name for reference in REFERENCES]
    parser.add_argument(
        "--only", choices=names, nargs="+", default=names, metavar="NAME", help="problems (default: all)"
    )
    args = parser.parse_args()
    lines, ratios = [" | ".join(HEADER), " | ".join(["---"] * len(HEADER))], []
    for reference in REFERENCES:
        if reference.name in args.only:
            words, ratio = row(reference)
            lines.append(" | ".join(words))
            ratios.append(ratio)
            print(lines[-1], flush=True)
    path = Path(args.out)
    path.parent.mkdir(parents=True, exist_ok=True)
    table = "".join(f"| {line} |\n" for line in lines)
    path.write_text(f"# Reference suite\n\n{table}{summary(ratios)}{NOTE}")
    print(f"table: {path}")


if __name__ == "__main__":
    run(main)
