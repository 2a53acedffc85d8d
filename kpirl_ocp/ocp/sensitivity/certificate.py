"""Evidence for the derivative of a solution: measured quantities, their bounds, and a sentence for each that fails.

A derivative exists where the implicit function theorem holds: at a KKT point with linearly independent active
constraints (LICQ), strict complementarity and a positive reduced Hessian. All of it is measured.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np

from kpirl_ocp.errors import CertificateError, ProblemError
from kpirl_ocp.ocp.conditions.structure import own_derivatives_agree
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.pictures import card, draw, svg
from kpirl_ocp.types import Mask, Solution, Status, record

Policy = Literal["raise", "flag"]

# Every bound is far from what rounding and a solver tolerance of 1e-10 leave behind, and far from what well-posed
# problems show. All but that of the KKT residual are on relative numbers, so that they do not depend on units.
KKT_RESIDUAL = 1e-6
CURVATURE = 1e-8
QUALIFICATION = 1e-5
STEP = 1e-5
MARGIN = 1e-6
CHANGE = 1e-4
KINK = 1e-3
LINEAR_RESIDUAL = 1e-8
DISTANCE = 1e-4  # for solutions of status ACCEPTABLE
WRONG_DERIVATIVES = "The problem's own derivatives are not those of its dynamics: correct them, or leave them out."
_SOLVED = (Status.CONVERGED, Status.ACCEPTABLE)  # the KKT residual has a bound of its own


@dataclass(frozen=True, kw_only=True, repr=False)
class Certificate:
    """Evidence for one gradient.

    solution: the inner solution that was differentiated.
    failures: one sentence for every condition that does not hold; empty when the gradient is certified.
    """

    solution: Solution
    failures: tuple[str, ...]

    @property
    def certified(self) -> bool:
        """True if every condition holds."""
        return not self.failures

    def evidence(self) -> dict[str, float]:
        """Every single number that was measured, by name."""
        numbers = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        return {name: float(value) for name, value in numbers.items() if isinstance(value, float | np.floating)}

    def _repr_html_(self) -> str:
        facts = {name.replace("_", " "): f"{value:.2g}" for name, value in self.evidence().items()}
        return card(str(self), facts, svg(draw(self.solution.panels())))

    def __repr__(self) -> str:
        numbers = [f"{name}={value:.2g}" for name, value in self.evidence().items()]
        return f"{type(self).__name__}({', '.join([str(self), *numbers])})"

    def __str__(self) -> str:
        return "certified" if self.certified else "NOT certified: " + " ".join(self.failures)


@dataclass(frozen=True, kw_only=True, repr=False)
class SensitivityCertificate(Certificate):
    """Evidence for a derivative of the solution by the implicit function theorem.

    kkt_residual: of the solution, relative (`KKTResiduals.worst`).
    curvature: smallest eigenvalue of the reduced Hessian, with every decision scaled by its own curvature within its
        own and the next stage (`KKTSystem.roots`); positive at a strict minimum (second-order condition). Its sign is
        exact, its size an upper estimate. Infinite when the active constraints leave no freedom.
    qualification: smallest singular value of the active Jacobian with rows of length one (LICQ); infinite when nothing
        is active.
    distance: from the solution to the point that was differentiated, relative. Newton steps lead from one to the other
        and remove the error that the solver's tolerance leaves, which is large where the unit of the cost is large.
    step: length of one more Newton step on the KKT conditions with this active set, relative: the error there.
    margin: after that step, the smallest multiplier of an active row or slack of an inactive one (strict
        complementarity), relative to the terms that it balances or consists of; infinite without inequalities.
    change: relative change of the adjoint under that step; for a tangent, of the adjoint of a function with the tangent
        as its gradient. Small if the solution is close enough to be differentiated. Zero for quadratic programs, whose
        second derivatives are constant. Where second derivatives of the solution served on, it is the change from them.
    kink: relative disagreement of derivatives with finite differences to either side, along the adjoint or tangent and
        along psi, s_0 and the context. Large where the problem is not smooth. Quadratic programs are not tested along
        x, and without psi and context not along s_0.
    linear_residual: relative residual of the adjoint or tangent system.
    active: (n_rows,) bool; rows as in `sensitivity.rows.rows_of`: bounds, path constraints, then equalities.
    barrier: tau; if it is positive, the derivative is that of the smoothed problem.
    """

    kkt_residual: float
    curvature: float
    qualification: float
    distance: float
    step: float
    margin: float
    change: float
    kink: float
    linear_residual: float
    active: Mask
    barrier: float


def undefined(solution: Solution, active: Mask) -> SensitivityCertificate:
    """The certificate for a solution at which a derivative is NaN or infinite, so that nothing can be measured."""
    names = ("curvature", "qualification", "distance", "step", "margin", "change", "kink", "linear_residual")
    return SensitivityCertificate(
        solution=solution,
        failures=(
            "A derivative at the solution is NaN or infinite: look at its status, and at dynamics and costs there.",
            *([] if solution.status in _SOLVED else [_not_converged(solution)]),
        ),
        kkt_residual=solution.residuals.worst,
        active=active,
        barrier=solution.barrier,
        **dict.fromkeys(names, np.nan),
    )


def certified(solution: Solution, active: Mask, evidence: Mapping[str, float]) -> SensitivityCertificate:
    """The certificate from measurements, with a sentence for every condition that fails."""
    found: dict[str, Any] = {"kkt_residual": solution.residuals.worst, **evidence}
    failures = [] if solution.status in _SOLVED else [_not_converged(solution)]
    if solution.status is Status.ACCEPTABLE and not found["distance"] <= DISTANCE:
        failures.append(_NOT_ACCEPTABLE.format(found["distance"]))
    failures += [text.format(found[name], bound) for name, bound, text in _AT_MOST if not found[name] <= bound]
    failures += [text.format(found[name], bound) for name, bound, text in _AT_LEAST if not found[name] >= bound]
    found |= {"solution": solution, "failures": tuple(failures), "active": active, "barrier": solution.barrier}
    return record(SensitivityCertificate, found)


def judged(
    policy: str, problem: OCP, solution: Solution, active: Mask, evidence: Mapping[str, float] | None
) -> SensitivityCertificate:
    """The certificate from measurements; evidence is None where derivatives are not finite.

    It also fails if derivatives that the problem supplies (`OCP.derivatives`) are not those of its dynamics.

    Raises CertificateError if the certificate has failures and the policy is not "flag".
    """
    found = undefined(solution, active) if evidence is None else certified(solution, active, evidence)
    if not own_derivatives_agree(problem):
        found = replace(found, failures=(*found.failures, WRONG_DERIVATIVES))
    require(policy, found)
    return found


_NOT_ACCEPTABLE = (
    "The solver calls the solution acceptable, but it is {:.1e} from the point that was differentiated: pass another "
    "guess, or rescale the problem."
)
# Written so that NaN fails.
_AT_MOST = (
    ("kkt_residual", KKT_RESIDUAL, "The KKT residual is {:.1e}, above {:.0e}: solve to a tighter tolerance."),
    (
        "step",
        STEP,
        "A Newton step still moves the solution by {:.1e}: solve to a tighter tolerance.",
    ),
    (
        "change",
        CHANGE,
        "A Newton step changes the adjoint by {:.1e} of itself: the solution is too far from exact, or about to jump; "
        "solve to a tighter tolerance, or add effort weight.",
    ),
    (
        "kink",
        KINK,
        "Derivatives disagree with differences by {:.1e}: the solution sits on a kink; use a smooth cost and dynamics "
        "(softplus or tanh for ReLU).",
    ),
    ("linear_residual", LINEAR_RESIDUAL, "The KKT system was solved to {:.1e} only: it is close to singular."),
)
_AT_LEAST = (
    (
        "curvature",
        CURVATURE,
        "The reduced Hessian has relative eigenvalue {:.1e}, below {:.0e}: this is no strict minimum; add effort "
        "weight, or start elsewhere.",
    ),
    (
        "qualification",
        QUALIFICATION,
        "Active constraints depend on each other (singular value {:.1e}): remove one.",
    ),
    (
        "margin",
        MARGIN,
        "An inequality is weakly active, or its side is unclear (margin {:.1e}): the gradient may differ on either "
        "side; use policy='smooth', or a solver with_barrier(tau).",
    ),
)


def check_policy(policy: str, allowed: tuple[str, ...]) -> None:
    """Raise ProblemError for a policy that is not among the allowed ones."""
    if policy not in allowed:
        raise ProblemError(f"policy must be one of {', '.join(allowed)}; got {policy!r}.")


def require(policy: str, certificate: Certificate, of: str = "the gradient") -> None:
    """Raise CertificateError if a gradient is not certified and the policy is not "flag"."""
    if not certificate.certified and policy != "flag":
        raise CertificateError(f"{of} is {certificate} (policy='flag' returns it all the same.)", certificate)


def _not_converged(solution: Solution) -> str:
    return f"The solver did not converge: {solution.status.name}, {solution.status.value}"
