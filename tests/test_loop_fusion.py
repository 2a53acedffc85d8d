"""Generated C with joined loops gives the same numbers to the last bit, and writes less."""

import re
import shutil

import casadi as ca
import numpy as np
import pytest

from kpirl_ocp.ocp.codegen import compiler as native
from kpirl_ocp.ocp.codegen import kernels
from kpirl_ocp.ocp.codegen.rewriting.copy_elision import with_fewer_copies
from kpirl_ocp.ocp.codegen.rewriting.loop_fusion import with_joined_loops

needs_compiler = pytest.mark.skipif(not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="there is no C compiler")
UNARY = (lambda x: x * x, ca.fabs, ca.exp, lambda x: -x, lambda x: 2 - x, lambda x: x > 0, lambda x: x[::-1, :])
BINARY = (
    ca.fmin,
    ca.fmax,
    lambda x, y: x + y,
    lambda x, y: x - y,
    lambda x, y: x * y,
    lambda x, y: ca.if_else(x > 0, y, 0),
)


def random_graph(seed, rows, columns, operations=60):
    """Operations on the entries of arrays of two lengths, with products, copies and a call between them."""
    rng = np.random.default_rng(seed)
    x, y = ca.MX.sym("x", rows, columns), ca.MX.sym("y", rows, columns)
    weight = ca.DM(rng.normal(size=(rows, rows)) / rows)
    called = ca.Function("called", [x, y], [x * y + 1, y * y - x])
    arrays = [x, y]
    for _ in range(operations):
        some, other = (arrays[rng.integers(max(0, len(arrays) - 8), len(arrays))] for _ in range(2))
        kind = rng.integers(10)
        if kind < 4:
            arrays.append(UNARY[rng.integers(len(UNARY))](0.5 * some))
        elif kind < 8:
            arrays.append(BINARY[rng.integers(len(BINARY))](some, other))
        elif kind == 8:
            arrays.append(ca.mac(weight, some, other))
        else:
            arrays += called.call([some, other], False, True)
    inner = ca.Function("inner", [x, y], [*arrays[-4:], ca.sum1(ca.horzcat(*arrays[-20:]))])
    return ca.Function("outer", [x, y], inner.call([x, y], False, True))


def generated(function):
    generator = ca.CodeGenerator("code.c")
    generator.add(function)
    return generator.dump()


@needs_compiler
@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (3, 2), (8, 1), (25, 3)])
@pytest.mark.parametrize("seed", range(3))
def test_numbers_are_the_same_to_the_last_bit(seed, rows, columns, tmp_path, monkeypatch):
    """Sums of products are rounded twice; what is compared with is compiled as it stands."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(native, "FLAGS", (*native.FLAGS, "-ffp-contract=off"))
    function, rng = random_graph(seed, rows, columns), np.random.default_rng(1)
    joined = native.compiled(function)
    monkeypatch.setattr(kernels, "with_joined_loops", lambda source: source)
    monkeypatch.setattr(native, "FLAGS", (*native.FLAGS, "-O0"))
    apart = native.compiled(function)
    assert len(list((tmp_path / "kpirl_ocp").iterdir())) == 2
    point = [rng.normal(size=function.size_in(i)) for i in range(function.n_in())]
    point[0][0, 0] = np.nan
    for one, many in zip(joined(*point), apart(*point), strict=True):
        np.testing.assert_array_equal(np.array(one), np.array(many))


def test_what_no_other_loop_needs_stays_a_number():
    x = ca.MX.sym("x", 25)
    inner = ca.Function("inner", [x], [1 - ca.exp(x) ** 2])
    outer = ca.Function("outer", [x], inner.call([x], False, True))
    joined = with_joined_loops(with_fewer_copies(generated(outer)))
    (loop,) = re.findall(r"for \(casadi_int i=0; i<25; \+\+i\) \{\n(.*?)\n  \}", joined, re.DOTALL)
    assert len(set(re.findall(r"\bentry_w\d", loop))) == 2
    assert len(re.findall(r"^    w\d\[i\] = ", loop, re.MULTILINE)) == 1, "the output, and not exp or its square"


@pytest.mark.parametrize("between", ["  w3 = casadi_dot(9, w1, w1);", "  casadi_copy(w1, 9, w2);", "  arg1[0]=w1;"])
def test_a_loop_is_not_moved_over_what_depends_on_it(between):
    loop = "  for (i=0, rr=w1, cs=w2; i<9; ++i) *rr++ = casadi_sq( *cs++ );\n"
    source = f"static int casadi_f1(const casadi_real** arg) {{\n{loop}{between}\n{loop}}}\n"
    assert with_joined_loops(source).count("for (") == 2
    assert with_joined_loops(source.replace(between, "  w3 = 1.;")).count("for (") == 1
