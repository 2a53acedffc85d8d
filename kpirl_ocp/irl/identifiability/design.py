"""The next demonstration: from which start and goal would one teach most about psi?

With the posterior covariance P of psi, a demonstration with the plan Jacobian J brings, before it is seen,

    1/2 log det(I + J P J^T / sigma^2)

nats of information (Bayesian D-optimal design: Chaloner and Verdinelli, 1995), to first order around the present psi.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kpirl_ocp.irl.hypergradients.certificate import Hypergradient
from kpirl_ocp.irl.identifiability.identify import Identification
from kpirl_ocp.irl.identifiability.plan_jacobian import CONVERGED, plan_jacobian
from kpirl_ocp.irl.learning.horizons import Problems, problems_of
from kpirl_ocp.types import Array, Demonstration


def expected_information(
    problem: Problems,
    found: Identification,
    candidates: Sequence[Demonstration],
    method: Hypergradient = CONVERGED,
) -> Array:
    """Expected information [nats] of a demonstration from each candidate (n,); the largest is the one to ask for.

    Args:
        problem: as in `identify`.
        found: of the demonstrations so far.
        candidates: of which s0 and context count; what they observe does not.
        method: as in `identify`.

    Raises:
        CertificateError: a plan has no certified derivative, under the policy "raise".
    """
    root = np.linalg.cholesky(found.posterior + 1e-15 * found.spread @ found.spread.T) / found.noise
    gains = []
    for own, candidate in zip(problems_of(problem, candidates), candidates, strict=True):
        jacobian = plan_jacobian(own, candidate, found.psi, method).jacobian @ root
        gains.append(0.5 * np.log1p(np.linalg.svd(jacobian, compute_uv=False) ** 2).sum())
    return np.array(gains)
