"""Functions of vectors in the C core, in every build that this processor runs, at lengths around those of vectors."""

import ctypes
from pathlib import Path

import numpy as np
import pytest

from kpirl_ocp.ocp.interior_point import library as c

LENGTHS = [*range(0, 10), 15, 16, 17, 23, 31, 32, 33, 39, 63, 64, 65, 100, 323]


@pytest.fixture(params=c._levels())
def core(request):
    """A build of the core, whose functions are declared here."""
    build = ctypes.CDLL(str(Path(c.library()._name).with_name(f"_core{request.param}.so")))
    build.kpirl_mpc_norm_inf.restype = build.kpirl_mpc_largest_fall.restype = ctypes.c_double
    build.kpirl_mpc_log_sum.restype = ctypes.c_double
    return build


def at(array):
    return ctypes.c_void_p(array.ctypes.data)


@pytest.mark.parametrize("count", LENGTHS)
def test_the_norm_is_the_largest_number_and_nan_wherever_there_is_one(core, count):
    values = np.random.default_rng(count).normal(size=count)
    assert core.kpirl_mpc_norm_inf(at(values), count) == np.abs(values).max(initial=0.0)
    assert core.kpirl_mpc_all_finite(at(values), count) == 1
    for i in range(count):
        wrong = values.copy()
        wrong[i] = 9.0
        assert core.kpirl_mpc_norm_inf(at(wrong), count) == 9.0
        for one, norm in ((-np.inf, np.inf), (np.nan, np.nan)):
            wrong[i] = one
            np.testing.assert_equal(core.kpirl_mpc_norm_inf(at(wrong), count), norm)
            assert core.kpirl_mpc_all_finite(at(wrong), count) == 0
        wrong[-1 - i] = np.inf  # beside a NaN, unless in its place
        wanted = np.inf if 2 * i + 1 == count else np.nan
        np.testing.assert_equal(core.kpirl_mpc_norm_inf(at(wrong), count), wanted)


@pytest.mark.parametrize("count", LENGTHS)
def test_the_largest_fall_is_that_of_any_entry(core, count):
    rng = np.random.default_rng(count)
    value, change = rng.uniform(0.1, 2, count), rng.normal(size=count)

    def found(least):
        return core.kpirl_mpc_largest_fall(at(value), at(change), count, ctypes.c_double(least))

    assert found(0.5) == max(0.5, (-change / value).max(initial=0.0))
    assert found(1e3) == 1e3
    for i in range(count):
        before, change[i] = change[i], -50 * value[i]
        assert found(0.5) == -change[i] / value[i]
        change[i] = before


@pytest.mark.parametrize("count", LENGTHS)
def test_a_sum_of_logarithms_takes_small_and_large_numbers_in_any_order(core, count):
    values = 10.0 ** np.random.default_rng(count).uniform(-300, 300, count)
    expected = np.log(values).sum()
    np.testing.assert_allclose(core.kpirl_mpc_log_sum(at(values), count), expected, rtol=1e-13, atol=1e-10)


@pytest.mark.parametrize("rows", LENGTHS)
def test_products_of_columns_with_vectors_are_exact_for_whole_numbers_and_read_nothing_else(core, rows):
    rng, columns = np.random.default_rng(rows), 7
    held = np.full(rows + 2, np.nan)  # x, with what is no part of it on either side
    held[1:-1] = rng.integers(-9, 10, rows)
    matrix, start = rng.integers(-9, 10, (columns, rows)).astype(float), rng.integers(-9, 10, columns).astype(float)
    found = start.copy()
    core.kpirl_mpc_transposed_times_vector(at(matrix), rows, columns, at(held[1:]), at(found))
    np.testing.assert_array_equal(found, start + matrix @ held[1:-1])
