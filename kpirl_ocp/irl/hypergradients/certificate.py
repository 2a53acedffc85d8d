"""What every hypergradient returns: loss, gradient, and the evidence for the gradient.

A hypergradient is the derivative dL/dpsi of the IRL loss at the trajectory that the inner solver plans for psi. The
method is an object; calling it with a problem, a demonstration and psi gives a `HypergradientResult`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import CertificateError, ProblemError
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Guess
from kpirl_ocp.types import Array, Demonstration, Solution

Policy = Literal["raise", "flag"]


@dataclass(frozen=True, kw_only=True)
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

    def __str__(self) -> str:
        return "certified" if self.certified else "NOT certified: " + " ".join(self.failures)


class HypergradientResult(NamedTuple):
    """loss, gradient (n_psi,) and certificate."""

    loss: float
    gradient: Array
    certificate: Certificate


class Hypergradient(Protocol):
    """A way to differentiate the IRL loss with respect to psi."""

    def __call__(
        self, problem: OCP, demonstration: Demonstration, psi: ArrayLike, guess: Guess = None
    ) -> HypergradientResult:
        """Loss, gradient (n_psi,) and certificate at psi (n_psi,).

        Raises:
            CertificateError: under the policy "raise", when the certificate has failures.
            ProblemError: shapes that do not fit.
        """
        ...


def enforce(policy: str, result: HypergradientResult) -> HypergradientResult:
    """The result, or CertificateError if it is not certified and the policy is not "flag"."""
    if not result.certificate.certified and policy != "flag":
        raise CertificateError(
            f"the gradient is {result.certificate} (policy='flag' returns it all the same.)", result.certificate
        )
    return result


def check_policy(policy: str, allowed: tuple[str, ...]) -> None:
    """Raise ProblemError for a policy that is not among the allowed ones."""
    if policy not in allowed:
        raise ProblemError(f"policy must be one of {', '.join(allowed)}; got {policy!r}.")


def seen(problem: OCP, demonstration: Demonstration) -> Array:
    """Observations of the demonstration as (n_z, T+1). Raises ProblemError if they do not fit the problem."""
    expected = (problem.horizon + 1, problem.n_observations)
    if demonstration.observations.shape != expected:
        raise ProblemError(
            f"the demonstration's observations must be (T+1, n_z) = {expected}, got {demonstration.observations.shape}."
        )
    return demonstration.observations.T


def not_finite(loss: float, gradient: Array) -> list[str]:
    """The failure that NaN or infinity is, if there is any."""
    if np.isfinite(loss) and np.isfinite(gradient).all():
        return []
    return ["The loss or its gradient is NaN or infinite: look at the solution's status and the dynamics."]
