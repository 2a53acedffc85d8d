"""The Lanczos method against dense eigenvalues, and the filter against its definition."""

import casadi as ca
import numpy as np
import pytest

from kpirl_ocp.ocp.linear.lanczos import lanczos, magnitude, outermost, start

RNG = np.random.default_rng(0)


def process(matrix, products, lowest=False):
    """start -> the outermost value, its error and vector, the magnitude, as the Lanczos method finds them."""
    begin = ca.MX.sym("start", len(matrix))
    diagonal, offdiagonal, basis = lanczos(lambda v: ca.DM(matrix) @ v, begin, products)
    value, error, coordinates = outermost(diagonal.numel())(diagonal, offdiagonal, int(lowest))
    outputs = [value, error, basis @ coordinates, magnitude(diagonal.numel())(diagonal, offdiagonal)]
    function = ca.Function("process", [begin], outputs)
    return lambda vector: [np.array(output).ravel() for output in function(vector)]


def outer(matrix, products, lowest=False):
    """The outermost value, and the largest absolute one."""
    value, error, vector, largest = process(matrix, products, lowest)(start(len(matrix)))
    if np.isfinite(value):
        residual = np.linalg.norm(matrix @ vector - value * vector)
        np.testing.assert_allclose(error, residual, rtol=0, atol=1e-10 * max(1.0, np.abs(matrix).max()))
        np.testing.assert_allclose(np.linalg.norm(vector), 1, rtol=1e-12)
    return value[0], largest[0]


@pytest.mark.parametrize("size", [1, 2, 7])
def test_as_many_products_as_dimensions_give_outer_eigenvalues(size):
    matrix = RNG.normal(size=(size, size))
    matrix = matrix + matrix.T
    values = np.linalg.eigvalsh(matrix)
    low, largest = outer(matrix, size + 3, lowest=True)
    found = [low, outer(matrix, size + 3)[0], largest]
    np.testing.assert_allclose(found, [values[0], values[-1], np.abs(values).max()], rtol=0, atol=1e-12)


def test_outer_eigenvalues_of_a_large_matrix_come_first_and_stay_inside_the_spectrum():
    matrix = np.diag(np.concatenate([np.linspace(1, 2, 200), [5.0, -3.0]]))
    (low, largest), (high, _) = outer(matrix, 12, lowest=True), outer(matrix, 12)
    np.testing.assert_allclose([low, high, largest], [-3, 5, 5], rtol=1e-6)
    assert -3 - 1e-12 <= low <= high <= 5 + 1e-12


@pytest.mark.parametrize("scale", [2.0, -2.0, 1e-120])
@pytest.mark.parametrize("lowest", [True, False])
def test_what_comes_after_an_invariant_subspace_is_left_out(scale, lowest):
    value, error, vector, largest = process(scale * np.eye(50), 5, lowest)(start(50))
    np.testing.assert_allclose(np.abs(vector @ start(50)), np.linalg.norm(start(50)), rtol=1e-12)
    np.testing.assert_allclose([value[0], largest[0]], [scale, abs(scale)], rtol=1e-12)
    assert error <= 1e-12 * abs(scale)


def test_nothing_but_zeros_has_magnitude_zero():
    assert outer(np.zeros((3, 3)), 3) == (0, 0)


def test_operator_without_dimensions_has_no_eigenvalue():
    assert np.isnan(float(outermost(0)([], [], 0)[0]))


def test_nan_stays_nan():
    assert np.isnan(outer(np.full((3, 3), np.nan), 3)).all()
    matrix = np.eye(3)
    matrix[1, 2] = matrix[2, 1] = np.nan
    assert np.isnan(outer(matrix, 3)).all()
