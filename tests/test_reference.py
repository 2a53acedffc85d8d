"""Classic problems end at their published optima, with every solver that takes them."""

import numpy as np
import pytest
from reference.problems import REFERENCES

from kpirl_ocp import Ipopt, Riccati, Status

QUICK = [reference for reference in REFERENCES if reference.steps <= 120]


@pytest.mark.parametrize("reference", REFERENCES, ids=lambda reference: reference.name)
def test_riccati_meets_the_published_optimum(reference):
    case = reference.build(reference.steps)
    found = Riccati(tolerance=1e-9).solve(case.problem, case.s0, guess=case.guess)
    assert found.status is Status.CONVERGED
    assert case.sign * found.objective == pytest.approx(reference.optimum, rel=reference.digits)


@pytest.mark.parametrize("reference", QUICK, ids=lambda reference: reference.name)
def test_ipopt_finds_the_same_plan(reference):
    case = reference.build(reference.steps)
    ours, peer = (s.solve(case.problem, case.s0, guess=case.guess) for s in (Riccati(), Ipopt()))
    assert peer.status is Status.CONVERGED
    assert ours.objective == pytest.approx(peer.objective, rel=1e-8)
    np.testing.assert_allclose(ours.states, peer.states, rtol=0, atol=1e-3 * (1 + np.abs(peer.states).max()))


@pytest.mark.parametrize("name", ["Bryson-Denham", "brachistochrone", "least energy"])
def test_finer_steps_come_closer_to_the_continuous_optimum(name):
    (reference,) = [reference for reference in REFERENCES if reference.name == name]
    errors = []
    for steps in (reference.steps // 4, reference.steps):
        case = reference.build(steps)
        found = Riccati(tolerance=1e-9).solve(case.problem, case.s0, guess=case.guess).raise_if_failed()
        errors.append(abs(found.objective - reference.optimum))
    assert errors[1] < errors[0] / 2
