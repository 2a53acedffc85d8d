"""What an export and an exported solver refuse, in one sentence that names it; and what they take all the same."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from exported import PLAIN, folder, loaded
from problems import TABLE

from kpirl_ocp import OCP, SQP, GradientDescent, Riccati, Soft, Status, Trajectory
from kpirl_ocp.errors import CompilerError, FileError, ProblemError
from kpirl_ocp.ocp.codegen.portable_c import portable
from kpirl_ocp.ocp.export import ExportedSolver, export_c
from kpirl_ocp.types import Multipliers

pytestmark = pytest.mark.usefixtures("virtual_machine")  # for the steps in Python
S, U = ca.MX.sym("s", 2), ca.MX.sym("u")
START = [1.0, 0.0]


def steered(successor):
    return OCP.from_expressions(
        state=S,
        action=U,
        horizon=6,
        dynamics=successor,
        stage_cost=ca.sumsqr(S) + 0.1 * U**2,
        terminal_cost=10 * ca.sumsqr(S),
        action_bounds=(-1, 1),
    )


def controller(solver=Riccati()):  # noqa: B008
    out, case = folder("integrator", solver)
    seen = case.demonstration
    return loaded(out), case.problem, (seen.s0, case.psi, seen.context)


def test_the_page_of_a_folder_says_which_states_and_actions_are_not_the_users(tmp_path):
    q = ca.MX.sym("q")
    problem = OCP.from_expressions(
        state=S,
        action=U,
        static=q,
        dynamics=S + U,
        stage_cost=U**2,
        terminal_cost=q**2,
        soft=Soft(S - q, 1.0),
        horizon=3,
    )
    page = (export_c(problem, Riccati(), tmp_path / "controller") / "README.md").read_text()
    assert (
        "added after your own states: static decisions = 1, slacks at s_T = 2; after your own actions: slacks = 2"
        in page
    )


# ---- arguments -------------------------------------------------------------------------------------------------------

PAIRS = r"examples must be pairs of s0 and context, at least one, as in \[\(\[0, 0\], \[1\]\)\]; got "
ONE_SUCH = r"the solver must be one such as Riccati\(\) or SQP\(\), got "
WRONG_ARGUMENTS = {
    "no pairs": ({"examples": [[1.0, 0.0, 0.0]]}, rf"{PAIRS}\[\[1\.0, 0\.0, 0\.0\]\]\."),
    "one pair": ({"examples": ([0.0, 0.0, 0.0], [])}, PAIRS),
    "none": ({"examples": []}, rf"{PAIRS}\[\]\."),
    "the name of a solver": ({"solver": "riccati"}, f"{ONE_SUCH}'riccati'"),
    "the class of a solver": ({"solver": Riccati}, f"{ONE_SUCH}<class "),
}


@pytest.mark.parametrize("case", WRONG_ARGUMENTS)
def test_wrong_arguments_are_named(case, tmp_path):
    given, message = WRONG_ARGUMENTS[case]
    with pytest.raises(ProblemError, match=message):
        export_c(**{"problem": steered(S + U), "solver": Riccati(), "directory": tmp_path} | given)


@pytest.mark.parametrize("name", ["a file", "a file/inside"])
def test_a_place_where_nothing_can_be_written_is_named(name, tmp_path):
    (tmp_path / "a file").write_text("")
    with pytest.raises(FileError, match=f"cannot write a controller to '.*{name}': Not a directory"):
        export_c(steered(S + 0.1 * U), Riccati(), tmp_path / name)


# ---- what CasADi generates -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["linear", "bspline"])
@pytest.mark.parametrize("solver", [Riccati(), GradientDescent(20, 1e-2, project=True), SQP()], ids=str)
def test_look_up_tables_are_exported_whole(kind, solver, tmp_path):
    x = np.linspace(-3, 3, 25)
    table = ca.interpolant("table", kind, [x], np.sin(x) + 0.1 * x)
    problem = steered(ca.vertcat(S[0] + 0.1 * S[1], S[1] + 0.1 * (U - table(S[0]))))
    ours = loaded(export_c(problem, solver, tmp_path)).solve(problem, START)
    reference = solver.solve(problem, START)
    assert ours.status is reference.status
    np.testing.assert_allclose(ours.actions, reference.actions, rtol=0, atol=1e-13)


class BlackBox(ca.Callback):
    def __init__(self):
        ca.Callback.__init__(self)
        self.construct("black_box", {"enable_fd": True})

    def get_sparsity_in(self, _):
        return ca.Sparsity.dense(2, 1)

    def get_sparsity_out(self, _):
        return ca.Sparsity.dense(2, 1)

    def eval(self, given):
        return given


ODE = {"x": S, "p": U, "ode": ca.vertcat(S[1], U - ca.sin(S[0]))}
IMPLICIT = {"x": S, "p": U, "g": S - ca.vertcat(0.1 * U, U)}
NOT_GENERATED = {
    "flow": lambda: ca.integrator("flow", "cvodes", ODE, 0.0, 0.1)(x0=S, p=U)["xf"],
    "implicit": lambda: ca.rootfinder("implicit", "newton", IMPLICIT)(x0=S, p=U)["x"],
}


@pytest.mark.parametrize("name", NOT_GENERATED)
def test_a_part_without_c_is_refused_by_name(name, tmp_path):
    with pytest.raises(ProblemError, match=f"no C for '{name}'"):
        export_c(steered(NOT_GENERATED[name]()), Riccati(), tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_callback_is_refused_by_name(tmp_path):
    black_box = BlackBox()  # which has to be kept
    with pytest.raises(ProblemError, match="no C for 'black_box'"):
        export_c(steered(black_box(S) + ca.vertcat(0, U)), Riccati(), tmp_path)


def test_generated_text_of_another_form_fails_loudly():
    with pytest.raises(CompilerError, match="static memory"):
        portable("static int casadi_f0_counter = 0;\n")
    with pytest.raises(CompilerError, match="casadi_mtimes_dense"):
        portable("  casadi_mtimes_dense(w0, 2, 2, w1, 1, w2, 0);\n")


# ---- where it is written ---------------------------------------------------------------------------------------------


def test_an_earlier_export_is_removed_and_nothing_else(tmp_path):
    problem = TABLE["lqr"]().problem.unconstrained()
    export_c(problem, Riccati(), tmp_path, prefix="first")
    (tmp_path / "notes.txt").write_text("mine")
    second = GradientDescent(5, 1e-3)
    export_c(problem, second, tmp_path, prefix="second")
    assert not list(tmp_path.rglob("first*"))
    assert not list(tmp_path.glob("*_newton.c"))
    assert (tmp_path / "notes.txt").read_text() == "mine"
    start = np.ones(problem.n_states)
    arguments = (problem, start, np.ones(problem.n_parameters), np.zeros(problem.n_context))
    found = loaded(tmp_path).solve(*arguments)
    np.testing.assert_allclose(found.actions, second.solve(*arguments).actions, rtol=0, atol=1e-12)


def test_a_file_of_an_earlier_export_that_was_changed_is_not_lost(tmp_path):
    problem = TABLE["lqr"]().problem
    export_c(problem, Riccati(), tmp_path, prefix="first")
    changed = tmp_path / "first_newton.c"
    changed.write_text("/* mine */")
    with pytest.raises(FileError, match="changed since"):
        export_c(problem, Riccati(), tmp_path, prefix="second")
    assert changed.read_text() == "/* mine */"


def test_files_that_do_not_belong_to_the_export_are_not_compiled(tmp_path):
    problem = TABLE["lqr"]().problem
    out = export_c(problem, Riccati(), tmp_path)
    (out / "stranger.c").write_text("#error stranger\n")
    assert ExportedSolver(out, PLAIN).size > 0


@pytest.mark.parametrize("prefix", ["int", "sin", "class", "gamma", "y0", "mpc", "core", "solution", "casadi_real"])
def test_a_prefix_that_c_or_the_code_has_is_refused(prefix, tmp_path):
    with pytest.raises(ProblemError, match="something called"):
        export_c(TABLE["lqr"]().problem, Riccati(), tmp_path, prefix=prefix)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "wrong", [{"psi": [np.nan, 1.0]}, {"psi": [1.0]}, {"examples": [([np.inf] * 4, [0.0] * 2)]}], ids=str
)
def test_numbers_that_c_cannot_start_from_are_refused(wrong, tmp_path):
    with pytest.raises(ProblemError, match=r"finite|length"):
        export_c(TABLE["integrator"]().problem, Riccati(), tmp_path, **wrong)


NOT_FINITE = {
    "dynamics": {"dynamics": ca.vertcat(S[0], np.nan * S[1] + U)},
    "dynamics outside their domain": {"dynamics": ca.vertcat(S[0], ca.log(S[1] - 1) + U)},
    "cost": {"stage_cost": ca.sumsqr(S) / 0.0 + U**2},
    "terminal cost": {"terminal_cost": np.nan * S[0]},
    "derivative": {"stage_cost": ca.norm_2(S) + U**2},
}


@pytest.mark.parametrize("part", NOT_FINITE)
@pytest.mark.parametrize("solver", [Riccati(), GradientDescent(20, 1e-2, project=True), SQP()], ids=str)
def test_a_problem_that_is_not_finite_at_its_example_is_refused_before_anything_is_written(part, solver, tmp_path):
    finite = {"dynamics": S + 0.1 * ca.vertcat(S[1], U), "stage_cost": ca.sumsqr(S) + U**2, "terminal_cost": S[0] ** 2}
    problem = OCP.from_expressions(state=S, action=U, horizon=6, action_bounds=(-1, 1), **finite | NOT_FINITE[part])
    with pytest.raises(ProblemError, match=r"the example with s0 = \[0\.0, 0\.0\] meets NaN or infinity"):
        export_c(problem, solver, tmp_path)
    assert not list(tmp_path.iterdir())


# ---- what a solver is called with ------------------------------------------------------------------------------------


@pytest.mark.parametrize("which", range(3))
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_an_input_that_is_not_finite_is_a_status(which, value):
    ours, problem, arguments = controller()
    arguments = [np.array(argument, float) for argument in arguments]
    arguments[which][0] = value
    found = ours.solve(problem, *arguments)
    assert found.status is Status.NOT_FINITE
    assert np.isnan(found.actions).all()
    assert "NaN or infinite" in found.message


def test_unknown_settings_and_values_are_refused():
    ours, _, _ = controller()
    with pytest.raises(ProblemError, match=r"tolerence: no such setting; there are max_iterations, .*tolerance"):
        ours.set(tolerence=1e-3)
    with pytest.raises(ProblemError, match="max_iterations cannot be 'many'"):
        ours.set(max_iterations="many")
    with pytest.raises(ProblemError, match="out of its range"):
        ours.set(tolerance=-1.0)
    with pytest.raises(ProblemError, match="out of its range"):
        ours.set(time_limit=1.0)  # without a clock


@pytest.mark.parametrize("setting", [{"steps": 1}, {"barrier": 1e-3}])
def test_settings_that_sqp_does_not_know_are_refused(setting):
    ours, _, _ = controller(SQP())
    with pytest.raises(ProblemError, match="cannot do this"):
        ours.set(**setting)


def test_arrays_of_wrong_shapes_are_refused():
    ours, problem, (s0, psi, context) = controller()
    plan = ours.solve(problem, s0, psi, context)
    with pytest.raises(ProblemError, match="s0 must have length"):
        ours.solve(problem, s0[:-1], psi, context)
    with pytest.raises(ProblemError, match="context must have length"):
        ours.solve(problem, s0, psi)
    short = Trajectory(plan.states[:-1], plan.actions)
    with pytest.raises(ProblemError, match="states must be"):
        ours.solve(problem, s0, psi, context, guess=short)
    with pytest.raises(ProblemError, match="guess must be"):
        ours.solve(problem, s0, psi, context, guess=plan.actions)
    for name, value in vars(plan.multipliers).items():
        fewer = Multipliers(**(vars(plan.multipliers) | {name: np.zeros((2, 7))}))
        assert value.shape != (2, 7)
        with pytest.raises(ProblemError, match=f"multipliers.{name} must be"):
            ours.solve(problem, s0, psi, context, guess=replace(plan, multipliers=fewer))
        with pytest.raises(ProblemError, match=f"multipliers.{name} must be"):
            ours.shift(problem, replace(plan, multipliers=fewer))
    with pytest.raises(ProblemError, match="actions must be"):
        ours.gradient(problem, s0, psi, context, plan, np.zeros_like(plan.states), np.zeros((1, 1)))


def test_gradients_of_sqp_are_refused():
    ours, problem, arguments = controller(SQP())
    plan = ours.solve(problem, *arguments)
    with pytest.raises(ProblemError, match="cannot do this"):
        ours.gradient(problem, *arguments, plan, plan.states, plan.actions)
