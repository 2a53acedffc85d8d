"""The exported C by itself: compilers, sanitizers, memory, threads, deadlines, and the folder's own tests."""

import ctypes
import hashlib
import json
import re
import shutil
import subprocess
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from exported import COMPILERS, PLAIN, STRICT, C, built, folder, loaded, ran
from object_files import objects_of
from problems import TABLE

import kpirl_ocp
from kpirl_ocp import OCP, GradientDescent, Riccati
from kpirl_ocp.errors import CompilerError
from kpirl_ocp.irl.cases.network_cases import placing_case
from kpirl_ocp.ocp.codegen import portable_c as generated
from kpirl_ocp.ocp.export import export_c
from kpirl_ocp.ocp.solvers.sqp import SQP, program

CONVERGED, REAL_TIME = Riccati(), Riccati(steps=1, barrier=1e-2)
SANITIZED = ("-std=c99", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
SINGLE = ("-DKPIRL_MPC_FLOAT", "-Wdouble-promotion")
COUNTED = (*PLAIN, "-fPIC", "-DCOUNT_ALLOCATIONS", "-Wl,--wrap=malloc,--wrap=calloc,--wrap=realloc,--wrap=free")


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("solver", [CONVERGED, SQP()], ids=lambda solver: type(solver).__name__)
def test_the_recorded_solves_are_reproduced(solver, compiler):
    out, _ = folder("integrator", solver)
    assert "all agree" in built(out, out / "test/test.c", *STRICT, compiler=compiler)


@pytest.mark.parametrize("macro", ["FLOAT", "NO_HEAP"])
def test_other_builds_reproduce_them_too(macro):
    out, _ = folder("integrator", CONVERGED)
    assert "all agree" in built(out, out / "test/test.c", *STRICT, f"-DKPIRL_MPC_{macro}")


def test_single_precision_agrees_by_the_objective_where_the_cost_is_flat(tmp_path):
    s, u = ca.SX.sym("s"), ca.SX.sym("u", 2)  # of which the sum matters, and hardly anything else
    problem = OCP.from_expressions(
        state=s,
        action=u,
        dynamics=s + 0.1 * ca.sum1(u),
        stage_cost=s**2 + 1e-6 * ((u[0] - 0.3) ** 2 + u[1] ** 2),
        horizon=10,
        action_bounds=(-1, 1),
    )
    out = export_c(problem, CONVERGED, tmp_path, examples=[([1.0], [])])
    said = built(out, out / "test/test.c", *PLAIN, SINGLE[0])
    assert "all agree" in said
    (error, size, cost, value), _ = (
        map(float, numbers)
        for numbers in re.findall(r"actions differ by (\S+) of (\S+), objectives by (\S+) of (\S+)", said)
    )
    assert error > 0.1 * size
    assert cost < 1e-3 * value


@pytest.mark.parametrize("single", [True, False], ids=["a program in double", "a program in single"])
def test_a_program_of_the_other_precision_than_the_library_does_not_link(single, tmp_path):
    out, _ = folder("integrator", CONVERGED)
    objects = objects_of(("gcc", *STRICT, *SINGLE[:single]), out)
    program = [*SINGLE[: not single], f"-I{out}", str(out / "example/main.c"), *objects]
    linked = subprocess.run(["gcc", "-std=c99", *program, "-lm"], capture_output=True, text=True, cwd=tmp_path)
    missing = "kpirl_mpc_init" if single else "kpirl_mpc_init_single"
    assert linked.returncode != 0
    assert re.findall(r"undefined reference to .(\w+)", linked.stderr) == [missing]


@pytest.mark.parametrize("flags", [(), ("-DKPIRL_MPC_FLOAT",)], ids=["double", "single"])
def test_the_program_of_the_documentation_reaches_its_goal(flags, tmp_path):
    page = (Path(__file__).parents[1] / "docs/howto/deploy.md").read_text()
    statement = re.search(r"```python\n(import casadi.*?)```", page, re.DOTALL)
    text = re.search(r"```c\n(/\* main\.c \*/.*?)```", page, re.DOTALL)
    exec(statement[1].replace('"controller"', repr(str(tmp_path / "c"))), {})
    program = tmp_path / "main.c"
    program.write_text(text[1])
    assert built(tmp_path / "c", program, *PLAIN, *flags) == "-0.20\n"


SOLVERS = {"lqr": GradientDescent(5, 1e-3, project=True), "integrator": CONVERGED, "swing-up": SQP()}


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("name", SOLVERS)
def test_single_precision_is_not_promoted(name, compiler, tmp_path):
    case = TABLE[name]()
    problem = case.problem.unconstrained() if name == "lqr" else case.problem
    out = export_c(problem, SOLVERS[name], tmp_path, psi=case.psi)
    command = [compiler, *PLAIN, *SINGLE, "-fsyntax-only", *map(str, out.glob("*.c"))]
    read = subprocess.run(command, capture_output=True, text=True)
    assert (read.returncode, read.stderr) == (0, "")


ARM = ("-mcpu=cortex-m7", "-mthumb", "-mfpu=fpv5-sp-d16", "-mfloat-abi=hard", "-DKPIRL_MPC_NO_HEAP")


@pytest.mark.skipif(shutil.which("arm-none-eabi-gcc") is None, reason="there is no compiler for ARM without a system")
@pytest.mark.parametrize("name", ["integrator", "tanh network"])
def test_a_microcontroller_compiles_it(name, tmp_path):
    out, _ = folder(name, CONVERGED)
    for source in out.glob("*.c"):
        command = ["arm-none-eabi-gcc", *STRICT, *SINGLE, *ARM, "-c", str(source), "-o", str(tmp_path / "object.o")]
        compiled = subprocess.run(command, capture_output=True, text=True)
        assert (compiled.returncode, compiled.stderr) == (0, "")


def test_the_placing_controller_takes_a_quarter_of_a_megabyte_in_single_precision(tmp_path):
    data = placing_case(10, steps=1, count=1)
    out = export_c(data.bounded, REAL_TIME, tmp_path, psi=data.psi.ravel())
    program = tmp_path / "size.c"
    program.write_text(
        '#include <stdio.h>\n#include "kpirl_mpc_memory.h"\n'
        'int main(void) { printf("%d\\n", (int)sizeof(kpirl_mpc)); return 0; }\n'
    )
    assert int(built(out, program, *STRICT, *SINGLE, names=[])) <= 256_000


@pytest.mark.parametrize("solver", [CONVERGED, REAL_TIME])
def test_random_inputs_neither_break_anything_nor_use_the_heap(solver):
    out, _ = folder("integrator", solver)
    built(out, out / "test/stress.c", *SANITIZED)
    assert "all hold" in ran(out / "stress.out", "400", "7")
    built(out, out / "test/stress.c", *COUNTED)
    assert "all hold" in ran(out / "stress.out", "300")


def test_the_example_plans_to_the_end():
    out, case = folder("integrator", CONVERGED)
    lines = built(out, out / "example/main.c", *STRICT).splitlines()
    assert sum("  ok " in line for line in lines) == case.problem.horizon


def test_two_controllers_in_two_threads_do_not_meet():
    out, _ = folder("integrator", CONVERGED)
    assert "the same" in built(out, C / "threads.c", *STRICT)


def test_two_prefixes_link_into_one_program(tmp_path):
    one, first = folder("integrator", CONVERGED)
    other, second = folder("swing-up", CONVERGED, "other")
    objects = objects_of(("gcc", *PLAIN, "-fPIC"), one)
    sources = [str(C / "pair.c"), *map(str, other.glob("*.c"))]
    command = ["gcc", *PLAIN, f"-I{one}", f"-I{other}", *sources, *objects, "-o", str(tmp_path / "pair"), "-lm"]
    subprocess.run(command, check=True)
    assert ran(tmp_path / "pair").split() == [str(case.problem.n_states) for case in (first, second)]


@pytest.mark.skipif(shutil.which("g++") is None, reason="there is no g++")
def test_cpp_includes_it_and_has_a_class(tmp_path):
    out, _ = folder("integrator", CONVERGED)
    objects = objects_of(("gcc", *STRICT), out)
    flags = ["-std=c++11", "-fno-exceptions", "-fno-rtti", "-Wall", "-Wextra", "-Wpedantic", "-Werror", f"-I{out}"]
    subprocess.run(["g++", *flags, str(C / "inclusion.cpp"), *objects, "-o", str(tmp_path / "cpp"), "-lm"], check=True)
    assert "NULL" in ran(tmp_path / "cpp")


def has_fuzzer():
    """Whether there is a clang with libFuzzer, which is a package of its own."""
    if shutil.which("clang") is None:
        return False
    command = ["clang", "-fsanitize=fuzzer", "-x", "c", "-", "-o", "/dev/null"]
    source = "int LLVMFuzzerTestOneInput(const char *data, long size) { return 0 * size * !data; }"
    return subprocess.run(command, input=source, text=True, capture_output=True).returncode == 0


@pytest.mark.skipif(not has_fuzzer(), reason="there is no libFuzzer")
def test_a_short_fuzz_finds_nothing():
    out, _ = folder("lqr", CONVERGED)
    program = out / "fuzz"
    flags = ["-std=c99", "-O0", "-fsanitize=fuzzer,address,undefined", f"-I{out}"]
    sources = [str(out / "test/fuzz.c"), *map(str, out.glob("*.c"))]
    subprocess.run(["clang", *flags, *sources, "-o", str(program), "-lm"], check=True)
    done = subprocess.run([program, "-runs=100", "-seed=1", "-max_len=512"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "Done 100 runs" in done.stderr


@pytest.mark.skipif(shutil.which("cmake") is None, reason="there is no cmake")
def test_cmake_builds_and_tests_it(tmp_path):
    """With warnings as errors, for gradient descent; the documentation's commands build an interior-point method."""
    case = TABLE["lqr"]()
    out = export_c(case.problem.unconstrained(), SOLVERS["lqr"], tmp_path / "controller", psi=case.psi)
    tmp_path = tmp_path / "build"
    subprocess.run(["cmake", "-S", out, "-B", tmp_path, "-DKPIRL_MPC_WERROR=ON"], check=True, capture_output=True)
    subprocess.run(["cmake", "--build", tmp_path], check=True, capture_output=True)
    tested = subprocess.run(["ctest", "--test-dir", tmp_path, "--no-tests=error"], check=False, capture_output=True)
    assert tested.returncode == 0, tested.stdout
    assert "ok" in ran(tmp_path / "kpirl_mpc_example")


@pytest.mark.parametrize("solver", [Riccati, SQP])
def test_a_deadline_ends_the_solve_where_it_is(solver):
    out, case = folder("swing-up", solver())
    ours, ticks = loaded(out), iter(range(1000))
    clock = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_void_p)(lambda _: next(ticks))
    ours.set(now=ctypes.cast(clock, ctypes.c_void_p), time_limit=3.0)
    seen = case.demonstration
    late = ours.solve(case.problem, seen.s0, case.psi, seen.context)
    assert late.iterations == 2  # the clock is looked at before every iteration
    assert "time limit" in late.message
    expected = solver(max_iterations=2).solve(case.problem, seen.s0, case.psi, seen.context)
    np.testing.assert_allclose(late.actions, expected.actions, rtol=0, atol=1e-12)


def test_shift_moves_a_plan_one_step_on():
    out, case = folder("integrator", CONVERGED)
    ours, seen = loaded(out), case.demonstration
    plan = ours.solve(case.problem, seen.s0, case.psi, seen.context)
    shifted = ours.shift(case.problem, plan, case.psi)
    np.testing.assert_array_equal(shifted.states[:-1], plan.states[1:])
    last = np.array(case.problem.transition(plan.states[-1], plan.actions[-1], case.psi)).ravel()
    np.testing.assert_allclose(shifted.states[-1], last, rtol=1e-14)
    for name in ("dynamics", "state", "action", "path"):
        before, after = getattr(plan.multipliers, name), getattr(shifted.multipliers, name)
        first = 1 if name == "state" else 0  # s_0 is given, and has no bounds
        np.testing.assert_array_equal(after[first:], np.vstack([before[1 + first :], before[-1:]]))
    np.testing.assert_array_equal(shifted.actions, np.vstack([plan.actions[1:], plan.actions[-1:]]))


def test_the_manifest_has_the_hashes_of_all_files():
    out, case = folder("integrator", CONVERGED)
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["problem"]["horizon"] == case.problem.horizon
    for name, expected in manifest["sha256"].items():
        assert hashlib.sha256((out / name).read_bytes()).hexdigest() == expected


def test_generated_code_has_no_globals_that_change():
    """CasADi keeps the memory of sqpmethod in a pool behind a static counter."""
    solver = program(TABLE["integrator"]().problem, SQP())
    source = generated.definitions([solver], {})
    assert "struct casadi_sqpmethod_data memory;" in source
    variables = re.findall(r"^static (?!const)[^(]*;$", source, flags=re.MULTILINE)
    assert variables == []
    assert not re.search(r"\bmalloc\b|\bprintf\b", source)


@pytest.mark.parametrize(
    ("known", "other"),
    [
        ("if (iter_count >= 50) break;", "if (iter_count > 49) break;"),
        ("return casadi_f0(arg, res, iw, w, mem);", "return casadi_f0(arg, res, iw, w, 0);"),
    ],
)
def test_another_text_of_sqpmethod_than_the_known_one_is_refused(known, other, monkeypatch):
    """Where its iterations end is changed in the text; a solver without an end would never return."""
    solver, generate = program(TABLE["lqr"]().problem, SQP(max_iterations=50)), generated._generate
    assert known in generate([solver])
    monkeypatch.setattr(generated, "_generate", lambda functions: generate(functions).replace(known, other))
    with pytest.raises(CompilerError, match="is not known here"):
        generated.definitions([solver], {})


def test_a_folder_holds_no_code_that_only_certificates_need():
    """Everything of the package's C that stands in a folder is the method, or what the folder adds to it."""
    out, _ = folder("lqr", CONVERGED)
    names = {path.name for path in out.glob("*.[ch]")}
    rooms = Path(kpirl_ocp.__file__).parent / "ocp"
    method, library, certificates = (
        {path.name for path in (rooms / room).rglob("*.[ch]")}
        for room in ("interior_point/c", "interior_point/c/library", "sensitivity/c")
    )
    assert not names & (certificates | library)
    assert names >= method - library
