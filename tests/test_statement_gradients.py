"""Implicit gradients of whatever can be stated, with their certificates, against differences of Ipopt's solutions."""

import numpy as np
import pytest
from statements import CASES, T

from kpirl_ocp import Demonstration, FiniteDifference, Implicit, Ipopt, Riccati


@pytest.mark.parametrize("solver", [Riccati(1e-12), Ipopt(1e-11)], ids=lambda solver: type(solver).__name__)
@pytest.mark.parametrize("name", CASES)
def test_certified_gradient_is_that_of_differences(name, solver):
    problem, (s0, psi, *context), _ = CASES[name]()
    times = np.linspace(0, 1, T + 1)
    observed = np.column_stack([0.7 * times, np.sin(np.pi * times)])
    demonstration = Demonstration(s0, np.concatenate([[], *context]), observed)
    implicit = Implicit(solver)(problem, demonstration, psi)
    assert implicit.certificate.certified
    reference = FiniteDifference(Ipopt(1e-11), step=1e-3, policy="flag")(problem, demonstration, psi)
    np.testing.assert_allclose(implicit.loss, reference.loss, rtol=1e-8)
    np.testing.assert_allclose(implicit.gradient, reference.gradient, rtol=1e-5, atol=1e-7)
