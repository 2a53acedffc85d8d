"""The Lanczos method against dense eigenvalues, and the filter against its definition."""

import casadi as ca
import numpy as np
import pytest

from kpirl_ocp.ocp.filter import Filter
from kpirl_ocp.ocp.spectrum import lanczos, ritz, start

RNG = np.random.default_rng(0)


def outer(matrix, products):
    """Ritz values and vectors of a matrix."""
    begin = ca.MX.sym("start", len(matrix))
    function = ca.Function("lanczos", [begin], lanczos(lambda v: ca.DM(matrix) @ v, begin, products))
    diagonal, beside, basis = (np.array(output) for output in function(start(len(matrix))))
    return ritz(diagonal.ravel(), beside.ravel(), basis.T.ravel())


@pytest.mark.parametrize("size", [1, 2, 7])
def test_as_many_products_as_dimensions_give_all_eigenvalues(size):
    matrix = RNG.normal(size=(size, size))
    matrix = matrix + matrix.T
    values, vectors = outer(matrix, size + 3)
    np.testing.assert_allclose(values, np.linalg.eigvalsh(matrix), rtol=0, atol=1e-12)
    np.testing.assert_allclose(matrix @ vectors, vectors * values, rtol=0, atol=1e-11)


def test_outer_eigenvalues_of_a_large_matrix_come_first_and_stay_inside_the_spectrum():
    spectrum = np.concatenate([np.linspace(1, 2, 200), [5.0, -3.0]])
    values, _ = outer(np.diag(spectrum), 12)
    np.testing.assert_allclose(values[[0, -1]], [-3, 5], rtol=1e-6)
    assert -3 - 1e-12 <= values[0] <= values[-1] <= 5 + 1e-12


def test_invariant_subspace_ends_the_iteration_early():
    values, vectors = outer(2 * np.eye(50), 12)
    np.testing.assert_allclose(values, [2])
    assert vectors.shape == (50, 1)


def test_nan_stays_nan():
    assert np.isnan(outer(np.full((3, 3), np.nan), 3)[0]).all()


def test_filter_accepts_progress_in_either_measure_and_never_returns_to_a_point_it_left():
    found = Filter.starting_at(1.0)
    assert found.accepts(1.0, 5.0, 0.0, 1.0, (0.5, 9.0))  # less violation, at a higher cost
    assert found.accepts(0.5, 9.0, 0.0, 1.0, (0.6, 3.0))  # less cost, at a higher violation
    assert not found.accepts(0.6, 3.0, 0.0, 1.0, (1.0, 5.0))
    assert not found.accepts(0.6, 3.0, 0.0, 1.0, (np.nan, 0.0))
    assert not found.accepts(0.6, 3.0, 0.0, 1.0, (2e4, -1e9))  # too far from feasible, whatever the cost


def test_filter_asks_for_a_decrease_in_proportion_to_the_slope_where_violation_is_small():
    found = Filter.starting_at(1.0)
    assert not found.accepts(1e-9, 1.0, -1.0, 1.0, (1e-9, 1.0 - 1e-6))
    assert found.accepts(1e-9, 1.0, -1.0, 1.0, (1e-9, 1.0 - 1e-3))
    assert found.pairs == []
