"""The interface of hypergradients: loss, gradient, and the evidence for the gradient.

A hypergradient is the derivative dL/dpsi of the IRL loss at the trajectory that the inner solver plans for psi. The
method is an object; calling it with a problem, a demonstration and psi gives a `HypergradientResult`.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

from numpy.typing import ArrayLike

from kpirl_ocp.ocp.interior_point.library import all_finite
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Guess
from kpirl_ocp.ocp.sensitivity.certificate import Certificate, require
from kpirl_ocp.pictures import brief
from kpirl_ocp.types import Array, Demonstration


class HypergradientResult(NamedTuple):
    """loss, gradient (n_psi,) and certificate."""

    loss: float
    gradient: Array
    certificate: Certificate

    def __repr__(self) -> str:
        return f"{type(self).__name__}(loss={self.loss:.6g}, gradient={brief(self.gradient)}, {self.certificate!r})"


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
    require(policy, result.certificate)
    return result


def nonfinite_failures(loss: float, gradient: Array) -> list[str]:
    """One failure message if loss or gradient is not finite, else none."""
    if math.isfinite(loss) and all_finite(gradient):
        return []
    return ["The loss or its gradient is NaN or infinite: look at the solution's status and the dynamics."]
