"""Functions in generated C that cannot fail are called without a test for failure."""

import re

import casadi as ca

from kpirl_ocp.ocp.codegen.rewriting.certain_calls import with_certain_calls

TEST = re.compile(r"if \(casadi_f\d+\(.*\)\) return 1;")


def nested():
    """C of a function that calls one twice that calls another one."""
    x = ca.MX.sym("x", 3)
    inner = ca.Function("inner", [x], [ca.sin(x)], {"never_inline": True})
    middle = ca.Function("middle", [x], [inner(x) + x], {"never_inline": True})
    generator = ca.CodeGenerator("code.c")
    generator.add(ca.Function("outer", [x], [middle(middle(x))]))
    return generator.dump()


def test_only_the_function_that_the_file_is_for_keeps_its_tests():
    before, after = nested(), with_certain_calls(nested())
    (entry,) = re.findall(r"return (casadi_f\d+)\(arg, res, iw, w, mem\);", before)
    body = re.search(rf"static int {entry}\(.*?^}}", before, re.MULTILINE | re.DOTALL)[0]
    assert len(TEST.findall(body)) == 2
    assert len(TEST.findall(before)) == 3
    assert body in after
    assert len(TEST.findall(after)) == 2


def test_all_tests_stay_where_a_function_can_fail():
    name = re.search(r"/\* inner:.*\nstatic int casadi_f\d+\(.*\n", nested())[0]
    source = nested().replace(name, f"{name}  if (external(arg, res, iw, w, 0)) return 1;\n")
    assert source != nested()
    assert with_certain_calls(source) == source
