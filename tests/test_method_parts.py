"""Parts of the interior-point method that only the C code calls: slopes, first costates, the end of progress."""

import ctypes
import subprocess
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from test_arrays_in_c import ARGUMENTS
from test_arrays_in_c import problem as problem_of_everything

import kpirl_ocp
from kpirl_ocp import OCP
from kpirl_ocp.ocp.codegen.compiler import find_compiler
from kpirl_ocp.ocp.interior_point import library as c
from kpirl_ocp.ocp.interior_point.cores import borrow_core

SOURCE = Path(__file__).parent / "c" / "method.c"
HEADERS = Path(kpirl_ocp.__file__).parent / "ocp" / "interior_point" / "c"
REAL, POINTER = ctypes.c_double, ctypes.c_void_p


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    """`tests/c/method.c`, linked with the library that the package has loaded."""
    built = tmp_path_factory.mktemp("method") / "method.so"
    include = [f"-I{folder}" for folder in (HEADERS, *filter(Path.is_dir, HEADERS.iterdir()))]
    options = ["-std=c99", "-Wall", "-Werror", "-O1", "-fPIC", "-shared", *include]
    subprocess.run([find_compiler(), *options, str(SOURCE), "-o", str(built), c.library()._name, "-lm"], check=True)
    found = ctypes.CDLL(str(built))
    found.slopes.argtypes = [POINTER, REAL, REAL, REAL, POINTER, POINTER]
    found.slopes.restype = None
    found.first_costates.argtypes = [POINTER] * 5
    found.first_costates.restype = None
    found.iterations_until_idle.argtypes = [POINTER, REAL]
    return found


def on_the_way(core, iterations):
    """Leave a core at the iterate of a solve that was stopped."""
    options = c.Options(iterations, 0, 1e-10, 0.0)
    core.solve(options, False, *(np.array([array]) for array in ARGUMENTS), [None])


@pytest.mark.parametrize("iterations", [0, 2])  # equalities are violated, or are not
@pytest.mark.parametrize("penalty", [0.0, 1.0, 1e3])
def test_the_slope_of_the_line_search_is_that_of_differences_of_its_barrier_function(parts, penalty, iterations):
    errors = []
    for h in (1e-4, 1e-5, 1e-6):
        known, found = REAL(), REAL()
        with borrow_core(problem_of_everything()) as core:
            on_the_way(core, iterations)
            addresses = ctypes.addressof(known), ctypes.addressof(found)
            parts.slopes(core.address, penalty, 0.1, h, *addresses)
        errors.append(abs(found.value / known.value - 1))
    assert min(errors) < 1e-7


@pytest.mark.parametrize(("horizon", "estimated"), [(10, True), (11, False)])
def test_first_costates_leave_no_gradient_by_the_states_unless_they_are_of_another_size(parts, horizon, estimated):
    """s' = 2 s + u with the cost s_T: the costates are 2^(T-1), .., 2, 1, which is too much from 1000 on."""
    s, u = ca.SX.sym("s"), ca.SX.sym("u")
    problem = OCP.from_expressions(state=s, action=u, horizon=horizon, dynamics=2 * s + u, terminal_cost=s)
    costates, gradient = np.empty(horizon), np.empty(2 * horizon + 1)
    x, numbers = np.zeros(2 * horizon + 1), [np.zeros(1), np.zeros(0), np.zeros(0), np.zeros((horizon + 1, 0))]
    given = c.Numbers(*map(c.address_of, numbers))
    with borrow_core(problem) as core:
        parts.first_costates(
            core.address, ctypes.addressof(given), *(array.ctypes.data for array in (x, costates, gradient))
        )
    expected = 2.0 ** np.arange(horizon)[::-1]
    np.testing.assert_array_equal(costates, expected if estimated else 0.0)
    np.testing.assert_array_equal(gradient[2::2], 0.0 if estimated else np.eye(horizon)[-1])


def test_iterations_without_progress_count_unless_they_are_regularised(parts):
    with borrow_core(problem_of_everything()) as core:
        on_the_way(core, 2)
        assert parts.iterations_until_idle(core.address, 0.0) == 6
        assert parts.iterations_until_idle(core.address, 1e-4) == 0
