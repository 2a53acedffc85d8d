"""Classic problems end at their published optima, with every solver that takes them; gradients and learning on them."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from reference import REFERENCES, coarse, gradient_error, learned, solve

from kpirl_ocp import SQP, Fatrop, Ipopt, Riccati, Status

PUBLISHED = [reference for reference in REFERENCES if reference.optimum is not None]
BY_NAME = {reference.name: reference for reference in REFERENCES}
LEARNED = [name for name, reference in BY_NAME.items() if reference.build(2).psi.size]
SCRIPT = Path(__file__).parents[1] / "scripts" / "reference_suite.py"


def test_there_are_at_least_twenty_problems():
    assert len(BY_NAME) == len(REFERENCES) >= 20
    assert len(PUBLISHED) >= 16
    assert len(LEARNED) >= 10


@pytest.mark.parametrize("reference", PUBLISHED, ids=lambda reference: reference.name)
def test_riccati_meets_the_published_optimum(reference):
    case = reference.build(reference.steps)
    found = solve(case, Riccati(tolerance=1e-9))
    assert found.status is Status.CONVERGED
    assert case.sign * found.objective == pytest.approx(reference.optimum, rel=reference.digits)


ROWS = [(name, solver) for name in BY_NAME for solver in (Ipopt(), Fatrop(1e-7))]
ROWS += [(name, SQP()) for name in BY_NAME if name != "free-flying robot"]  # it has several plans


@pytest.mark.parametrize(("name", "peer"), ROWS, ids=str)
def test_every_solver_that_takes_it_finds_the_same_plan(name, peer):
    case = coarse(BY_NAME[name])
    ours, other = solve(case, Riccati()), solve(case, peer)
    assert ours.status is other.status is Status.CONVERGED
    assert ours.objective == pytest.approx(other.objective, rel=1e-5 if isinstance(peer, Fatrop) else 1e-8)
    np.testing.assert_allclose(ours.states, other.states, rtol=0, atol=1e-3 * (1 + np.abs(other.states).max()))


def test_sqp_finds_a_plan_of_the_free_flying_robot_that_is_as_good_to_a_thousandth():
    case = coarse(BY_NAME["free-flying robot"])
    found = solve(case, SQP())
    assert found.status is Status.CONVERGED
    assert found.objective == pytest.approx(solve(case, Riccati()).objective, rel=1e-3)


@pytest.mark.parametrize(("name", "most"), [("unicycle, parking", 8), ("2R arm, reaching", 12), ("hanging chain", 12)])
def test_exact_hessians_make_sqp_take_few_steps(name, most):
    reference = BY_NAME[name]
    assert solve(reference.build(reference.steps), SQP()).iterations <= most


@pytest.mark.parametrize("name", ["Bryson-Denham", "brachistochrone", "least energy"])
def test_finer_steps_come_closer_to_the_continuous_optimum(name):
    reference, errors = BY_NAME[name], []
    for steps in (reference.steps // 4, reference.steps):
        found = solve(reference.build(steps), Riccati(tolerance=1e-9)).raise_if_failed()
        errors.append(abs(found.objective - reference.optimum))
    assert errors[1] < errors[0] / 2


@pytest.mark.parametrize("name", BY_NAME)
def test_the_certified_gradient_is_that_of_differences(name):
    assert gradient_error(coarse(BY_NAME[name])) < 1e-6


@pytest.mark.parametrize("name", LEARNED)
def test_true_parameters_are_learned_from_one_plan(name):
    loss, error = learned(coarse(BY_NAME[name], most=25))
    assert loss < 1e-12
    assert error < 1e-6


def test_the_script_writes_the_table(tmp_path):
    out = tmp_path / "suite"
    command = [sys.executable, SCRIPT, "--only", "least energy", "mass identified", "--out", out]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    lines = (out / "reference_suite.md").read_text().splitlines()
    rows = [line.strip("| ").split(" | ") for line in lines if line.startswith("| ")]
    assert [row[0] for row in rows] == ["problem", "---", "least energy", "mass identified"]
    assert rows[2][3:5] == ["6", "6.0006"]
    assert rows[3][3] == "-"
    assert float(rows[3][-1]) < 1e-6
