"""Compiled functions: the numbers of CasADi's virtual machine, one file per content, and no need of a compiler."""

import os
import shutil
import subprocess
import sys
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from problems import iiwa, integrator, lqr, network, pendulum, unconstrained

from kpirl_ocp import OCP, GradientDescent, Riccati, Status, Unrolled
from kpirl_ocp.errors import CompilerError
from kpirl_ocp.ocp.codegen import compiler as native
from kpirl_ocp.ocp.codegen import library_cache
from kpirl_ocp.ocp.codegen.kernels import with_fast_kernels
from kpirl_ocp.ocp.interior_point import machine_code

needs_compiler = pytest.mark.skipif(not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="there is no C compiler")


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "kpirl_ocp"


@pytest.fixture
def hide_compiler(tmp_path, monkeypatch):
    def hide():
        monkeypatch.setenv("PATH", str(tmp_path))
        native.compiler.cache_clear()

    yield hide
    native.compiler.cache_clear()


def polynomial(factor=2.0, name="polynomial"):
    x, p = ca.SX.sym("x", 3), ca.SX.sym("p")
    rounded = (x[0] + x[1]) - (x[1] + x[2])  # not x0 - x2 in floating point
    return ca.Function(name, [x, p], [ca.sumsqr(x) * p, ca.vertcat(factor * x[0], ca.fmax(x[1], p), rounded)])


@needs_compiler
@pytest.mark.parametrize("kind", ["linear", "bspline"])
def test_a_look_up_table_is_compiled_beside_the_kernels_of_this_package(kind, cache):
    """CasADi's code for tables has helpers whose names must not be those of our kernels."""
    x, grid = ca.MX.sym("x", 3), np.linspace(-3, 3, 25)
    table = ca.interpolant("table", kind, [grid], np.sin(grid))
    y = table(ca.mtimes(ca.MX(ca.DM(np.eye(3) + 0.1)), x)[0])
    function = ca.Function("looked_up", [x], [y, ca.gradient(y, x), ca.tanh(x)])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        compiled = native.compiled(function)
    assert compiled.class_name() == "External"
    for found, expected in zip(compiled([0.3, -0.4, 1.0]), function([0.3, -0.4, 1.0]), strict=True):
        np.testing.assert_allclose(np.array(found), np.array(expected), rtol=0, atol=1e-14)


@needs_compiler
def test_a_compiled_function_equals_the_virtual_machine(cache):
    function, rng = pendulum().problem.rollout.jacobian(), np.random.default_rng(0)
    compiled = native.compiled(function)
    assert compiled.class_name() != function.class_name()
    for _ in range(20):
        point = [rng.normal(size=function.size_in(i)) for i in range(function.n_in())]
        for found, expected in zip(compiled(*point), function(*point), strict=True):
            scale = max(1.0, np.abs(np.array(expected)).max(initial=0))
            np.testing.assert_allclose(np.array(found), np.array(expected), rtol=0, atol=1e-14 * scale)


@needs_compiler
def test_rounding_nan_and_infinity_are_those_of_the_virtual_machine(cache):
    function = polynomial()
    compiled = native.compiled(function)
    for point in ([1, 1e200, -1], [1, np.nan, -1], [np.nan, 1, 2], [np.inf, -np.inf, np.inf], [0, 0, -0.0]):
        for p in (1.0, np.nan):
            found, expected = (np.array(ca.vertcat(*f(point, p))) for f in (compiled, function))
            np.testing.assert_array_equal(found, expected)


@needs_compiler
@pytest.mark.parametrize(
    "shape",
    [
        (1, 1, 1),
        (1, 3, 1),
        (1, 4, 1),
        (1, 30, 1),
        (3, 5, 2),
        (7, 30, 1),
        (8, 25, 1),
        (9, 0, 2),
        (25, 100, 4),
        (100, 22, 1),
    ],
)
def test_dense_products_equal_numpy_whatever_the_tiles(cache, shape):
    """Heights around the vector length, and widths 1 to 11 that are cut into panels of up to five columns."""
    (rows, inner, _), rng = shape, np.random.default_rng(0)
    x, y, z = (ca.MX.sym(name, *size) for name, size in [("x", (rows, inner)), ("y", (inner, 11)), ("z", (rows, 11))])
    products = [ca.mac(x, y[:, :n], z[:, :n]) for n in range(1, 12)] + [ca.mtimes(x.T, z)]
    compiled = native.compiled(ca.Function("products", [x, y, z], products))
    X, Y, Z = (rng.normal(size=a.shape) for a in (x, y, z))
    *found, transposed = (np.array(value) for value in compiled(X, Y, Z))
    for n, value in enumerate(found, start=1):
        np.testing.assert_allclose(value, Z[:, :n] + X @ Y[:, :n], rtol=0, atol=1e-15 * (inner + 1) * 5)
    np.testing.assert_allclose(transposed, X.T @ Z, rtol=0, atol=1e-15 * (rows + 1) * 5)


@needs_compiler
@pytest.mark.parametrize("rows", [1, 2, 3, 4, 7, 8, 9, 16, 29, 31, 33, 65, 100])
def test_ordered_products_and_tanh_equal_the_virtual_machine_to_the_last_bit(tmp_path, rows):
    x, y, z = (ca.MX.sym(name, *size) for name, size in [("x", (rows, 23)), ("y", (23, 11)), ("z", (rows, 11))])
    products = [ca.mac(x, y[:, :n], z[:, :n]) for n in range(1, 12)] + [ca.mtimes(x.T, z), ca.tanh(x @ y)]
    function = ca.Function("products", [x, y, z], products)
    generator = ca.CodeGenerator("products.c")
    generator.add(function)
    flags, rewrite = machine_code.ORDERED
    code, library = tmp_path / "products.c", tmp_path / "products.so"
    code.write_text(rewrite(generator.dump()))
    native.link(native.find_compiler(), flags, [code], library)
    rng = np.random.default_rng(0)
    numbers = [rng.normal(size=a.shape) for a in (x, y, z)]
    for found, expected in zip(ca.external("products", str(library))(*numbers), function(*numbers), strict=True):
        np.testing.assert_array_equal(np.array(found), np.array(expected))


@needs_compiler
@pytest.mark.filterwarnings("error")  # it is compiled
def test_a_dense_product_lets_nan_and_infinity_through_in_their_own_entries(cache):
    x = ca.MX.sym("x", 20, 20)
    compiled = native.compiled(ca.Function("product", [x], [x @ ca.DM.eye(20), x @ ca.DM.ones(20, 3)]))
    X = np.ones((20, 20))
    X[3, 4], X[17, 0] = np.nan, np.inf
    total = np.array(compiled(X)[1])
    assert np.isnan(total[3]).all()
    assert np.isposinf(total[17]).all()
    np.testing.assert_array_equal(np.delete(total, [3, 17], axis=0), 20)


@needs_compiler
def test_tanh_of_an_array_is_within_two_units_in_the_last_place(cache):
    x = ca.MX.sym("x", 1003)  # no whole number of vectors
    compiled = native.compiled(ca.Function("bend", [x], [ca.tanh(x)]))
    for size in (1e-300, 1e-10, 1e-3, 0.1, 0.35, 1.0, 3.0, 30.0, 1e300):
        points = np.random.default_rng(0).uniform(-size, size, 1003)
        found, exact = np.array(compiled(points)).ravel(), np.tanh(points.astype(np.longdouble)).astype(float)
        assert np.max(np.abs(found - exact) / np.spacing(np.abs(exact))) <= 2, size
        assert np.abs(found).max() <= 1


@needs_compiler
def test_tanh_of_an_array_keeps_nan_infinity_and_the_sign_of_zero(cache):
    x = ca.MX.sym("x", 7)
    compiled = native.compiled(ca.Function("bend", [x], [ca.tanh(x)]))
    found = np.array(compiled([np.nan, np.inf, -np.inf, 0.0, -0.0, np.nan, -1000.0])).ravel()
    np.testing.assert_array_equal(found, [np.nan, 1, -1, 0, 0, np.nan, -1])
    assert np.signbit(found[4])
    assert not np.signbit(found[3])


@needs_compiler
@pytest.mark.parametrize("count", [1, 31, 32, 33, 100])
def test_the_least_and_the_largest_of_an_array_are_those_of_numpy_and_pass_over_nan(cache, count):
    x = ca.MX.sym("x", count)
    compiled = native.compiled(ca.Function("extremes", [x], [ca.mmin(x), ca.mmax(x)]))
    for place in range(0, count, 7):
        numbers = np.random.default_rng(place).normal(size=count)
        if count > 1:
            numbers[place] = np.nan
        assert [float(found) for found in compiled(numbers)] == [np.nanmin(numbers), np.nanmax(numbers)]


@needs_compiler
def test_the_smaller_and_the_larger_of_two_are_those_of_the_virtual_machine_to_the_last_bit(cache):
    numbers = [np.nan, np.inf, -np.inf, 0.0, -0.0, 1.0, 1.5, -1.0]
    pairs = np.array([[x, y] for x in numbers for y in numbers])
    x, y = (ca.MX.sym(name, len(pairs)) for name in "xy")
    function = ca.Function("pairs", [x, y], [ca.fmin(x, y), ca.fmax(x, y)])
    for found, expected in zip(native.compiled(function)(*pairs.T), function(*pairs.T), strict=True):
        np.testing.assert_array_equal(np.array(found), np.array(expected))
        np.testing.assert_array_equal(np.signbit(np.array(found)), np.signbit(np.array(expected)))


@needs_compiler
def test_generated_products_and_copies_use_the_kernels_of_this_package(cache):
    x = ca.MX.sym("x", 20, 20)
    generator = ca.CodeGenerator("product.c")
    generator.add(ca.Function("product", [x], [x @ x]))
    before, after = generator.dump(), with_fast_kernels(generator.dump())
    assert before.count("void casadi_mtimes_dense(") == after.count("void casadi_mtimes_dense(") == 1
    assert "kernel_tile" in after
    assert "memmove" in after
    assert "kernel_tanh" not in after
    nothing = ca.CodeGenerator("nothing.c")
    assert with_fast_kernels(nothing.dump()) == nothing.dump()


@needs_compiler
def test_the_cache_is_bounded_and_forgets_what_was_not_used_for_longest(cache, monkeypatch):
    native.compiled(polynomial(2.0))
    (first,) = cache.iterdir()
    native.compiled(polynomial(3.0))
    (second,) = set(cache.iterdir()) - {first}
    os.utime(first, ns=(0, 10**18))
    os.utime(second, ns=(0, 10**18 + 1))
    native.compiled(polynomial(2.0))  # using it makes it the younger one
    monkeypatch.setattr(library_cache, "_CACHE_BYTES", int(2.5 * first.stat().st_size))
    native.compiled(polynomial(4.0))
    assert first.exists()
    assert not second.exists()
    assert len(list(cache.iterdir())) == 2
    monkeypatch.setattr(library_cache, "_CACHE_BYTES", 1)
    assert float(native.compiled(polynomial(5.0))([1, 1, 1], 1)[1][0]) == 5  # the newest always stays
    assert len(list(cache.iterdir())) == 1


@needs_compiler
def test_a_library_that_another_process_removes_before_it_is_loaded_is_built_again(cache, monkeypatch):
    original, calls = native._library, []

    def removed_once(*arguments):
        library = original(*arguments)
        calls.append(library)
        if len(calls) == 1:
            library.unlink()
        return library

    monkeypatch.setattr(native, "_library", removed_once)
    assert float(native.compiled(polynomial(2.0))([1, 1, 1], 1)[1][0]) == 2
    assert len(calls) == 2


@needs_compiler
def test_compiling_the_same_function_twice_reuses_one_file(cache):
    native.compiled(polynomial())
    (library,) = cache.iterdir()
    before = library.stat()
    again = native.compiled(polynomial())
    assert list(cache.iterdir()) == [library]
    assert library.stat().st_ino == before.st_ino
    assert float(again([1, 2, 3], 2)[0]) == 28


@needs_compiler
def test_functions_of_one_name_and_different_content_do_not_share_a_file(cache):
    two, five = native.compiled(polynomial(2.0)), native.compiled(polynomial(5.0))
    assert len(list(cache.iterdir())) == 2
    assert (float(two([1, 1, 1], 1)[1][0]), float(five([1, 1, 1], 1)[1][0])) == (2, 5)


@needs_compiler
def test_nothing_is_written_but_the_library_and_that_not_to_the_working_directory(cache, tmp_path, monkeypatch):
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    native.compiled(polynomial())
    assert list(here.iterdir()) == []
    assert [path.suffix for path in cache.iterdir()] == [".so"]


def test_without_a_compiler_the_function_itself_is_returned_with_one_warning(cache, hide_compiler):
    hide_compiler()
    function = polynomial()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert native.compiled(function) is function
        assert native.compiled(polynomial(name="another")).name() == "another"
    assert [warning.category for warning in caught] == [RuntimeWarning]
    assert "no C compiler (cc, gcc, clang)" in str(caught[0].message)
    assert not cache.exists()


@needs_compiler
def test_gradient_descent_gives_the_same_solution_without_a_compiler(cache, hide_compiler):
    case, solver = pendulum(), GradientDescent(5, 0.1)
    one, other = replace(case.problem), replace(case.problem)  # nothing built for them yet
    fast = solver.solve(one, case.demonstration.s0, case.psi)
    assert list(cache.glob("*.so"))
    hide_compiler()
    with pytest.warns(RuntimeWarning, match="virtual machine"):
        slow = solver.solve(other, case.demonstration.s0, case.psi)
    np.testing.assert_allclose(fast.actions, slow.actions, rtol=0, atol=1e-14)


def bounded_pendulum():
    case = pendulum()
    return replace(case, problem=replace(case.problem, action_bounds=(-0.2, 0.2)))


STEPS = {  # problem; steps, of which more than 32 are taken in segments; whether they are taken again; demonstrations
    "scalar LQR": (lqr, 40, True, 1),
    "pendulum with bounds": (bounded_pendulum, 5, False, 1),
    "integrator": (lambda: unconstrained(integrator()), 40, False, 2),
    "iiwa": (lambda: unconstrained(iiwa()), 3, False, 1),
    "tanh network": (lambda: unconstrained(network("tanh")), 3, True, 2),
}


@needs_compiler
@pytest.mark.parametrize("name", STEPS)
def test_gradients_of_gradient_steps_are_the_same_without_a_compiler(name, cache, hide_compiler):
    build, steps, checkpoint, count = STEPS[name]
    case = build()
    problem, seen = case.problem, case.demonstration
    solver = GradientDescent(steps, 0.01, project=problem.has_action_bounds)
    method = Unrolled(solver, policy="flag", checkpoint=checkpoint)
    one, other = replace(problem), replace(problem)  # nothing built for them yet
    fast = method.batch(one, [seen] * count, case.psi)
    fast_plan = solver.solve(one, seen.s0, case.psi, seen.context)
    libraries = {path.name.partition("-")[0] for path in cache.glob("*.so")}
    assert libraries >= {"unrolled", "descent"}
    assert "losses" not in libraries  # of the steps to both sides of psi, which are compiled with the gradient
    hide_compiler()
    with pytest.warns(RuntimeWarning, match="virtual machine"):
        slow = method(other, seen, case.psi)
    slow_plan = solver.solve(other, seen.s0, case.psi, seen.context)
    for found in fast:
        assert found.certificate.certified == slow.certificate.certified
        assert found.loss == pytest.approx(slow.loss, rel=1e-12)
        np.testing.assert_allclose(found.gradient, slow.gradient, rtol=0, atol=1e-12 * np.abs(slow.gradient).max())
    np.testing.assert_allclose(fast_plan.actions, slow_plan.actions, rtol=0, atol=1e-14)


@pytest.mark.parametrize("value", [None, ""])
def test_without_the_variable_the_cache_is_in_the_home_directory(value, monkeypatch):
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    if value is not None:
        monkeypatch.setenv("XDG_CACHE_HOME", value)
    assert library_cache.cache_directory() == Path.home() / ".cache" / "kpirl_ocp"


@needs_compiler
@pytest.mark.parametrize("fault", ["compiler fails", "cache cannot be written"])
def test_when_compiling_fails_the_function_itself_is_returned_with_a_warning(fault, cache, monkeypatch, tmp_path):
    if fault == "compiler fails":
        (tmp_path / "cc").write_text("#!/bin/sh\necho too tired >&2\nexit 1\n")
        (tmp_path / "cc").chmod(0o755)
        monkeypatch.setattr(native, "compiler", lambda: str(tmp_path / "cc"))
    else:
        (tmp_path / "cache").write_text("a file where the directory should be")
    function = polynomial(name="unlucky")
    words = "too tired" if fault == "compiler fails" else "File exists|Not a directory"
    with pytest.warns(RuntimeWarning, match=words):
        assert native.compiled(function) is function


DAMAGE = {
    "truncated": lambda content: content[: len(content) // 2],
    "truncated by a byte": lambda content: content[:-1],
    "empty": lambda content: b"",
    "damaged": lambda content: content[:1000] + bytes([content[1000] ^ 1]) + content[1001:],
    "a text": lambda content: b"no library",
    "not sealed": lambda content: content[:-64],
}


@needs_compiler
@pytest.mark.parametrize("name", DAMAGE)
def test_a_library_that_is_not_as_it_was_built_is_built_again(name, cache):
    native.compiled(polynomial())
    (library,) = cache.iterdir()
    whole = library.read_bytes()
    library.unlink()  # it is mapped by this process: the damaged one is another file
    library.write_bytes(DAMAGE[name](whole))
    library.chmod(0o700)
    assert float(native.compiled(polynomial())([1, 2, 3], 2)[0]) == 28
    assert library_cache.sound(library)
    assert list(cache.iterdir()) == [library]


@pytest.fixture(scope="module")
def solve_elsewhere(tmp_path_factory):
    """A function that solves in a process of its own and gives the library in its cache; and that library."""
    home = tmp_path_factory.mktemp("elsewhere")
    code = (
        "import casadi as ca; from kpirl_ocp import OCP, Riccati; s, u = ca.SX.sym('s'), ca.SX.sym('u');"
        "ocp = OCP.from_expressions(state=s, action=u, dynamics=s + u, stage_cost=s**2 + u**2, horizon=3);"
        "print(Riccati(compile=True).solve(ocp, [1.0]).status.name)"
    )

    def solve():
        environment = {**os.environ, "XDG_CACHE_HOME": str(home / "cache")}
        command = [sys.executable, "-W", "error", "-c", code]
        result = subprocess.run(command, capture_output=True, text=True, check=True, cwd=home, env=environment)
        assert result.stdout.strip() == "CONVERGED"
        (library,) = (home / "cache" / "kpirl_ocp").iterdir()
        return library

    return solve, solve()


@needs_compiler
@pytest.mark.parametrize("name", DAMAGE)
def test_stage_functions_are_compiled_again_where_their_library_is_not_as_it_was_built(name, solve_elsewhere):
    """A truncated library would end the process."""
    solve, library = solve_elsewhere
    assert library_cache.sound(library)
    library.write_bytes(DAMAGE[name](library.read_bytes()))
    assert library_cache.sound(solve())


@needs_compiler
def test_threads_that_find_a_damaged_library_together_get_a_new_one(cache, monkeypatch):
    there = machine_code._there
    monkeypatch.setattr(
        machine_code, "_there", lambda library: [time.sleep(0.05), there(library)][1]
    )  # others look now
    first = machine_code.MachineCode([polynomial()], machine_code.STRAIGHT)
    first.wait()
    (library,) = cache.iterdir()
    content = library.read_bytes()
    for _ in range(5):
        library.unlink(missing_ok=True)
        library.write_bytes(DAMAGE["not sealed"](content))
        library.chmod(0o700)
        code = machine_code.MachineCode([polynomial()], machine_code.STRAIGHT)

        def look(code=code):
            code.begin()
            return code.addresses()

        with warnings.catch_warnings(), ThreadPoolExecutor(8) as pool:
            warnings.simplefilter("error", RuntimeWarning)
            for waiting in [pool.submit(look) for _ in range(16)]:
                waiting.result()
            code.wait()
            assert code.addresses()


BROKEN = {
    "junk": (
        'while [ $# -gt 0 ] && [ "$1" != -o ]; do shift; done; [ $# = 0 ] || echo junk > "$2"',
        "wrote no shared library",
    ),
    "nothing": ("exit 0", "wrote no shared library"),
    "fails": ("echo too tired >&2; exit 1", "too tired"),
    "hangs": ("sleep 100", "did not end within 0.5 s"),
}


@pytest.fixture
def broken_compiler(tmp_path, monkeypatch):
    """A `cc` that answers about itself and then does something else, or does not even answer."""

    def make(words, answers=True):
        native.identity.cache_clear()
        about = 'case "$*" in *-dM*) exit 0;; esac\n' if answers else ""
        (tmp_path / "cc").write_text(f"#!/bin/sh\n{about}{words}\n")
        (tmp_path / "cc").chmod(0o755)
        monkeypatch.setattr(native, "PATIENCE", 0.5)
        monkeypatch.setattr(native, "compiler", lambda: str(tmp_path / "cc"))
        monkeypatch.setattr(native, "find_compiler", lambda: str(tmp_path / "cc"))
        return str(tmp_path / "cc")

    yield make
    native.identity.cache_clear()


@pytest.mark.parametrize("answers", [True, False])
@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_compiler_is_named_and_nothing_of_it_is_kept(name, answers, cache, broken_compiler):
    words, sentence = BROKEN[name]
    command = broken_compiler(words, answers)
    function = polynomial(name="unlucky")
    with pytest.warns(RuntimeWarning, match=sentence):
        assert native.compiled(function) is function
    assert not cache.exists() or list(cache.iterdir()) == []
    folder = cache.parent / "folder"
    folder.mkdir(parents=True)
    (folder / "code.c").write_text("int x;")
    with pytest.raises(CompilerError, match=sentence):
        native.compile_folder(folder, (), command, ["code.c"])


@pytest.mark.parametrize("answers", [True, False])
@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_compiler_leaves_riccati_on_the_virtual_machine_with_a_warning(name, answers, cache, broken_compiler):
    broken_compiler(BROKEN[name][0], answers)
    s, u = ca.SX.sym("s"), ca.SX.sym("u")
    problem = OCP.from_expressions(state=s, action=u, dynamics=s + u, stage_cost=s**2 + u**2, horizon=3)
    with pytest.warns(RuntimeWarning, match="virtual machine"):
        assert Riccati(compile=True).solve(problem, [1.0]).status is Status.CONVERGED
    assert Riccati(compile=True).solve(problem, [2.0]).status is Status.CONVERGED
    assert not cache.exists() or list(cache.iterdir()) == []


@needs_compiler
@pytest.mark.parametrize("mode", [0o770, 0o707, 0o777])
def test_a_cache_that_others_may_write_is_refused(mode, cache):
    cache.mkdir(parents=True)
    cache.chmod(mode)
    function = polynomial()
    with pytest.warns(RuntimeWarning, match="other users may write to .*chmod go-w"):
        assert native.compiled(function) is function
    assert list(cache.iterdir()) == []


@needs_compiler
@pytest.mark.parametrize("mode", [0o720, 0o702])
def test_a_library_that_others_may_write_is_built_again(mode, cache):
    native.compiled(polynomial())
    (library,) = cache.iterdir()
    library.chmod(mode)
    before = library.stat().st_ino
    native.compiled(polynomial())
    assert library.stat().st_ino != before
    assert library.stat().st_mode & 0o077 == 0


@needs_compiler
def test_a_library_of_another_user_is_built_again(cache, monkeypatch):
    native.compiled(polynomial())
    (library,) = cache.iterdir()
    assert library_cache.sound(library)
    mine = os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: mine + 1)
    assert library_cache.sound(library) is (mine == 0)  # root's are trusted
