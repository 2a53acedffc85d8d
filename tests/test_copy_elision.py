"""Generated C with fewer copies gives the same numbers to the last bit, and moves less."""

import re
import shutil

import casadi as ca
import numpy as np
import pytest

from kpirl_ocp.ocp.codegen import compiler as native
from kpirl_ocp.ocp.codegen import kernels
from kpirl_ocp.ocp.codegen.rewriting.copy_elision import with_earlier_outputs, with_fewer_copies
from kpirl_ocp.ocp.codegen.rewriting.loop_fusion import with_joined_loops
from kpirl_ocp.ocp.problem.columns import scan

STEPS = 3
needs_compiler = pytest.mark.skipif(not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="there is no C compiler")


def recursion(rows, columns):
    """Some steps of a stage with products, and with outputs that are wanted once, twice or not at all."""
    rng = np.random.default_rng(0)
    first, second = (ca.DM(rng.normal(size=(rows, rows)) / rows) for _ in range(2))
    x, y, start = (ca.MX.sym(name, rows, columns) for name in ("x", "y", "start"))
    moved = ca.mac(first, x, start)
    kept = y * (second @ moved)
    outputs = [x + kept, kept, moved, kept, ca.horzcat(kept, moved)]
    stage = ca.Function("stage", [x, y, start], outputs)
    wide = ca.MX.sym("Y", rows, columns * STEPS)
    _, *found = scan(stage, x, [wide, start], STEPS)
    return ca.Function("recursion", [x, wide, start], [found[0] + found[2], found[1], found[3]])


def generated(function):
    generator = ca.CodeGenerator("code.c")
    generator.add(function)
    return generator.dump()


def bodies(source):
    return dict(re.findall(r"^static int (casadi_f\d+)\((.*?^}\n)", source, re.MULTILINE | re.DOTALL))


@needs_compiler
@pytest.mark.parametrize(("rows", "columns"), [(1, 4), (3, 2), (8, 1), (9, 5), (25, 10)])
def test_numbers_are_the_same_to_the_last_bit(rows, columns, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    function, rng = recursion(rows, columns), np.random.default_rng(1)
    shorter = native.compiled(function)
    monkeypatch.setattr(kernels, "with_fewer_copies", lambda source: source)
    longer = native.compiled(function)
    assert len(list((tmp_path / "kpirl_ocp").iterdir())) == 2
    point = [rng.normal(size=function.size_in(i)) for i in range(function.n_in())]
    for few, many, virtual in zip(shorter(*point), longer(*point), function(*point), strict=True):
        np.testing.assert_array_equal(np.array(few), np.array(many))
        np.testing.assert_allclose(np.array(few), np.array(virtual), rtol=0, atol=1e-13)


def test_products_start_from_what_they_are_added_to_and_outputs_are_computed_in_place():
    before = generated(recursion(25, 10))
    after = with_fewer_copies(before)
    assert before.count("casadi_mtimes_dense(w") == after.count("kernel_mtimes_from(w") == 2
    assert "casadi_clear(w" in before
    assert "casadi_clear(w" not in after
    (name,) = (name for name, body in bodies(after).items() if "kernel_mtimes_from" in body)
    copies = [len(re.findall(r"casadi_copy\(w\d+, \d+, res", bodies(source)[name])) for source in (before, after)]
    assert copies == [6, 3]  # each of three arrays goes to its last place at once
    stage = bodies(after)[name]
    assert re.search(r"\*w\d+=res\[0\] \? res\[0\] : w\+\d+", stage)


def test_functions_that_a_file_is_generated_for_compute_their_outputs_in_place_too():
    x, y = (ca.MX.sym(name, 25, 4) for name in "xy")
    stage = ca.Function("stage", [x, y], [x @ (y.T @ x)])
    before = generated(ca.Function("entry", [x, y], [stage(x, y)]))
    (entry,) = re.findall(r"return (casadi_f\d+)\(arg, res, iw, w, mem\);", before)
    copies = [
        len(re.findall(r"casadi_copy\(w\d+, 100, res", bodies(source)[entry]))
        for source in (before, with_fewer_copies(before))
    ]
    assert copies == [1, 0]


def reused_memory(*wanted):
    """Steps with outputs whose memory CasADi uses for another output of the same size; some of them are wanted."""
    x, low = (ca.MX.sym(name, 25, 4) for name in ("x", "low"))
    product = ca.DM(np.random.default_rng(3).normal(size=(25, 25))) @ x
    slope = product > 0
    stage = ca.Function("stage", [x, low], [slope * product, slope, ca.fmin(low, ca.fabs(product))])
    found = scan(stage, x, [low], STEPS)
    return ca.Function("steps", [x, low], [found[i] for i in wanted])


def test_an_output_whose_memory_is_filled_anew_is_computed_in_place():
    before = with_joined_loops(with_fewer_copies(generated(reused_memory(0, 1, 2))))
    stages = [bodies(source)["casadi_f1"] for source in (before, with_earlier_outputs(before))]
    copy = re.compile(r"casadi_copy\((w\d+), 100, res\[(\d)\]\)")
    ((array, place),) = copy.findall(stages[0])
    assert not copy.search(stages[1])
    assert f"*{array}0=res[{place}] ? res[{place}] : {array}" in stages[1]


@needs_compiler
@pytest.mark.parametrize("wanted", [(0,), (1,), (2,), (0, 2), (0, 1, 2)])
def test_outputs_in_memory_that_is_filled_anew_are_the_same(wanted):
    function, rng = reused_memory(*wanted), np.random.default_rng(4)
    point = [rng.normal(size=function.size_in(i)) for i in range(function.n_in())]
    found, expected = (ca.vertcat(*steps.call(point)) for steps in (native.compiled(function), function))
    np.testing.assert_allclose(np.array(found), np.array(expected), rtol=0, atol=1e-12)


def test_an_output_that_is_read_after_it_was_copied_keeps_its_copy():
    text = (
        "static int casadi_f1(const casadi_real** arg, casadi_real** res) {\n"
        "  casadi_real *w1=w+0, *w2=w+9;\n  casadi_copy(w1, 9, res[0]);\n"
        "  for (casadi_int i=0; i<9; ++i) {\n    casadi_real entry_w1 = w1[i], entry_w2;\n    entry_w2 = entry_w1;\n"
        "    w2[i] = entry_w2;\n  }\n}\n"
    )
    assert with_earlier_outputs(text) == text


def test_a_product_keeps_its_copy_if_anything_comes_between():
    text = "static int casadi_f1(const casadi_real** arg) {{\n{}}}\n"
    product = "  casadi_mtimes_dense(w1, 9, 9, w2, 1, w3, 0);\n"
    for between in ("  w4[0] = 1;\n", "  w3[0] = 1;\n"):
        copied = text.format("  casadi_copy(w4, 9, w3);\n" + between + product)
        assert with_fewer_copies(copied) == copied
    touched = text.format("  casadi_clear(w3, 9);\n  w3[0] = 1;\n" + product)
    assert with_fewer_copies(touched) == touched
    itself = text.format("  casadi_clear(w3, 9);\n" + product.replace("w2", "w3"))
    assert with_fewer_copies(itself) == itself
