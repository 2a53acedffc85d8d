"""The exported controller does what the Python solver does: same status, same iterations, same numbers."""

import json
import re
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from exported import COMPILERS, folder, loaded
from problems import TABLE

from kpirl_ocp import OCP, Fatrop, GradientDescent, Ipopt, Riccati, Status, Trajectory, Unrolled
from kpirl_ocp.errors import FileError, ProblemError
from kpirl_ocp.ocp.export import ExportedSolver, export_c
from kpirl_ocp.ocp.export.records import STATUS
from kpirl_ocp.ocp.interior_point.library import HORIZON, STAGE
from kpirl_ocp.ocp.sensitivity.solution_sensitivity import sensitivity
from kpirl_ocp.ocp.solvers.sqp import SQP

CONVERGED, REAL_TIME = Riccati(), Riccati(steps=1, barrier=1e-2)
# At active bounds z / y reaches 1e13: rounding of the last step can leave 1e-9, which a tolerance of 1e-10 allows.
SETTINGS = {
    "converged": (Riccati(1e-12), {"tolerance": 1e-12}),
    "real-time": (REAL_TIME, {"steps": 1, "barrier": 1e-2}),
    "smoothed": (Riccati(barrier=1e-4), {"barrier": 1e-4}),
}


def controller(name, solver=CONVERGED, compiler="gcc", **settings):
    out, case = folder(name, solver)
    ours = loaded(out, compiler=compiler)
    if settings:
        ours.set(**settings)
    return ours, case


def assert_same(ours, reference, tolerance=1e-9):
    assert (ours.status, ours.iterations) == (reference.status, reference.iterations)
    parts = [(ours.actions, reference.actions), (ours.states, reference.states)]
    parts += [(getattr(ours.multipliers, n), getattr(reference.multipliers, n)) for n in vars(reference.multipliers)]
    for found, expected in parts:
        np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * max(1, np.abs(expected).max(initial=0)))
    assert ours.objective == pytest.approx(reference.objective, rel=tolerance)
    assert ours.residuals.scale == pytest.approx(reference.residuals.scale, rel=tolerance)


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("form", SETTINGS)
@pytest.mark.parametrize("name", ["integrator", "swing-up", "tanh network"])
def test_interior_point_method_is_that_of_python(name, form, compiler):
    solver, settings = SETTINGS[form]
    ours, case = controller(name, compiler=compiler, **settings)
    problem, seen, rng = case.problem, case.demonstration, np.random.default_rng(0)
    guess = None
    for start in seen.s0 + 0.03 * np.arange(6)[:, None] * rng.normal(size=(6, len(seen.s0))):
        reference = solver.solve(problem, start, case.psi, seen.context, guess)
        assert_same(ours.solve(problem, start, case.psi, seen.context, guess), reference)
        guess = reference if reference.status.ok else None


def test_a_trajectory_as_guess_is_a_cold_start_from_there():
    ours, case = controller("integrator")
    actions = np.full((case.problem.horizon, case.problem.n_actions), 0.1)
    guess = case.problem.simulate(case.demonstration.s0, actions, case.psi)
    arguments = (case.problem, case.demonstration.s0, case.psi, case.demonstration.context, guess)
    assert_same(ours.solve(*arguments), Riccati().solve(*arguments))


@pytest.mark.usefixtures("virtual_machine")
@pytest.mark.parametrize("project", [False, True])
def test_gradient_descent_and_its_hypergradient_are_those_of_python(project, tmp_path):
    case = TABLE["pendulum"]()
    problem = replace(case.problem, state_bounds=(-np.inf, np.inf)) if project else case.problem.unconstrained()
    solver, seen = GradientDescent(8, 0.02, project=project), case.demonstration
    ours = loaded(export_c(problem, solver, tmp_path, psi=case.psi))
    plan = ours.solve(problem, seen.s0, case.psi, seen.context)
    assert_same(plan, solver.solve(problem, seen.s0, case.psi, seen.context))

    difference = np.array(problem.observe(plan.states.T)) - seen.observations.T
    slopes = np.zeros_like(plan.states)
    slopes[:, : len(difference)] = 2 * difference.T
    nothing = np.zeros_like(plan.actions)
    found, believed = ours.gradient(problem, seen.s0, case.psi, seen.context, plan, slopes, nothing)
    assert believed
    np.testing.assert_allclose(found.psi, Unrolled(solver)(problem, seen, case.psi).gradient, rtol=1e-12)

    def loss(start):
        states = solver.solve(problem, start, case.psi, seen.context).states
        return np.sum((np.array(problem.observe(states.T)) - seen.observations.T) ** 2)

    steps = 1e-6 * np.eye(len(seen.s0))
    slope = [(loss(seen.s0 + step) - loss(seen.s0 - step)) / 2e-6 for step in steps]
    np.testing.assert_allclose(found.s0, slope, rtol=1e-6, atol=1e-6)

    moved = replace(plan, trajectory=Trajectory(plan.states, plan.actions + 1e-6))
    assert not ours.gradient(problem, seen.s0, case.psi, seen.context, moved, slopes, nothing)[1]


@pytest.mark.parametrize(("barrier", "tolerance"), [(1e-4, 1e-11), (0.0, 1e-5)])
@pytest.mark.parametrize("name", ["integrator", "swing-up", "tanh network"])
def test_hypergradient_is_the_implicit_one(name, barrier, tolerance):
    """At a barrier that of the same smoothed problem; without one up to what the last tau of the solver leaves."""
    ours, case = controller(name, barrier=barrier)
    problem, seen, rng = case.problem, case.demonstration, np.random.default_rng(1)
    plan = Riccati(barrier=barrier).solve(problem, seen.s0, case.psi, seen.context)
    by_states, by_actions = rng.normal(size=plan.states.shape), rng.normal(size=plan.actions.shape)
    expected = sensitivity(problem, plan).pull(by_states, by_actions)
    found, believed = ours.gradient(problem, seen.s0, case.psi, seen.context, plan, by_states, by_actions)
    assert believed
    for key in ("psi", "s0", "context"):
        reference = getattr(expected, key)
        np.testing.assert_allclose(
            getattr(found, key), reference, rtol=0, atol=tolerance * max(1, np.abs(reference).max(initial=0))
        )


def test_a_plan_that_is_no_solution_has_no_gradient_to_be_believed():
    ours, case = controller("integrator")
    seen = case.demonstration
    plan = Riccati(max_iterations=1).solve(case.problem, seen.s0, case.psi, seen.context)
    slopes = np.ones_like(plan.states), np.ones_like(plan.actions)
    assert not ours.gradient(case.problem, seen.s0, case.psi, seen.context, plan, *slopes)[1]


def test_sqp_is_that_of_python_with_path_constraints(tmp_path):
    case = TABLE["integrator"]()
    seen, solver = case.demonstration, SQP()
    ours = loaded(export_c(case.problem, solver, tmp_path, psi=case.psi))
    found = ours.solve(case.problem, seen.s0, case.psi, seen.context)
    reference = solver.solve(case.problem, seen.s0, case.psi, seen.context)
    assert found.status is reference.status is Status.CONVERGED
    np.testing.assert_allclose(found.actions, reference.actions, rtol=0, atol=1e-12)
    optimum = Riccati().solve(case.problem, seen.s0, case.psi, seen.context)
    np.testing.assert_allclose(found.actions, optimum.actions, atol=1e-8)


def test_sqp_counts_its_quadratic_programs_and_takes_limit_and_tolerance_at_run_time(tmp_path):
    case = TABLE["swing-up"]()
    seen, problem = case.demonstration, case.problem
    ours = loaded(export_c(problem, SQP(), tmp_path, psi=case.psi))
    for limits in ({"max_iterations": 3}, {"max_iterations": 200, "tolerance": 1e-3}, {"tolerance": 1e-8}):
        ours.set(**limits)
        found = ours.solve(problem, seen.s0, case.psi, seen.context)
        reference = SQP(**limits).solve(problem, seen.s0, case.psi, seen.context)
        assert (found.status, found.iterations) == (reference.status, reference.iterations)
        np.testing.assert_allclose(found.actions, reference.actions, rtol=0, atol=1e-9)


def test_bounds_are_those_of_the_problem_at_hand():
    ours, case = controller("swing-up")
    seen, lower, upper = case.demonstration, *case.problem.action_bounds
    tighter = replace(case.problem, action_bounds=(0.8 * lower, 0.7 * upper))
    reference = Riccati().solve(tighter, seen.s0, case.psi, seen.context)
    assert_same(ours.solve(tighter, seen.s0, case.psi, seen.context), reference)
    with pytest.raises(ProblemError, match="other bounds are finite"):
        ours.solve(replace(case.problem, action_bounds=(-np.inf, np.inf)), seen.s0, case.psi, seen.context)


def test_another_problem_is_refused():
    ours, case = controller("integrator")
    other = TABLE["swing-up"]().problem
    with pytest.raises(ProblemError, match="was exported with"):
        ours.solve(other, np.zeros(other.n_states), np.ones(2), np.zeros(other.n_context))
    seen = case.demonstration
    longer = replace(case.problem, horizon=case.problem.horizon + 1, schedule=None)
    with pytest.raises(ProblemError, match="horizon"):
        ours.solve(longer, seen.s0, case.psi, seen.context)
    inputs = [
        ca.SX.sym(name, case.problem.stage_cost.size1_in(i)) for i, name in enumerate(("s", "u", "psi", "c", "d"))
    ]
    dearer = ca.Function("stage_cost", inputs, [2 * case.problem.stage_cost(*inputs)])
    with pytest.raises(ProblemError, match="functions or schedule differ"):
        ours.solve(replace(case.problem, stage_cost=dearer), seen.s0, case.psi, seen.context)


@pytest.mark.parametrize("solver", [Ipopt(), Fatrop()])
def test_what_cannot_be_exported_is_refused_with_the_alternatives(solver, tmp_path):
    with pytest.raises(ProblemError, match=r"Riccati\(steps=1.*GradientDescent.*SQP"):
        export_c(TABLE["lqr"]().problem, solver, tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("prefix", ["Left", "2arms", "_arm", "left-arm", "arm é", ""])
def test_a_prefix_that_is_no_lower_case_c_name_is_refused(prefix, tmp_path):
    with pytest.raises(ProblemError, match="prefix must be"):
        export_c(TABLE["lqr"]().problem, Riccati(), tmp_path, prefix=prefix)


@pytest.mark.parametrize(("structure", "known"), [("stage", STAGE), ("horizon", HORIZON)])
def test_python_calls_functions_with_the_pointers_of_the_header(structure, known):
    header = (folder("integrator", Riccati())[0] / "kpirl_mpc_model.h").read_text()
    for side, names in zip(("arguments", "results"), known, strict=True):
        (body,) = re.findall(rf"typedef struct kpirl_mpc_{structure}_{side} \{{(.*?)\}}", header, re.DOTALL)
        body = re.sub(r"/\*.*?\*/", "", body, flags=re.DOTALL)
        assert tuple(re.findall(r"\*(\w+)", body)) == names


def test_status_codes_are_those_of_python():
    header = (folder("integrator", Riccati())[0] / "kpirl_mpc_status.h").read_text()
    codes = {name: int(code) for name, code in re.findall(r"KPIRL_MPC_(\w+) = (-?\d+)", header)}
    assert {codes[status.name]: status for status in Status} == {c: s for c, s in STATUS.items() if c != 8}
    assert codes["TIME_LIMIT"] == 8
    assert all(code < 0 for name, code in codes.items() if name.startswith("ERROR"))


def test_a_folder_of_another_format_or_none_is_refused(tmp_path):
    with pytest.raises(FileError, match="does not exist"):
        ExportedSolver(tmp_path)
    (tmp_path / "manifest.json").write_text('{"format": 0}')
    with pytest.raises(FileError, match="export it again"):
        ExportedSolver(tmp_path)


def test_a_manifest_with_entries_of_another_kind_is_refused_by_name(tmp_path):
    """Their sizes are those of the structures that C writes into."""
    path = export_c(TABLE["lqr"]().problem, CONVERGED, tmp_path) / "manifest.json"
    whole = json.loads(path.read_text())
    sizes = [name for name, value in whole["problem"].items() if type(value) is int]
    assert len(sizes) == 11
    spoiled = {key: [whole | {key: value} for value in (None, 5, [], True)] for key in ("prefix", "sha256")}
    spoiled["solver.kind"] = [whole | {"solver": value} for value in (None, {}, [], {"kind": 3})]
    for name in sizes:
        values = (None, -1, 2.5, "2", True, 10**30)
        spoiled[f"problem.{name}"] = [whole | {"problem": whole["problem"] | {name: value}} for value in values]
    for name, manifests in spoiled.items():
        for manifest in manifests:
            path.write_text(json.dumps(manifest))
            with pytest.raises(FileError, match=f"{name} must be .*: export it again"):
                ExportedSolver(tmp_path)
    path.write_text(json.dumps(whole | {"prefix": "other"}))
    with pytest.raises(FileError, match="has no other_size in its sources"):
        loaded(tmp_path)


@pytest.fixture(scope="module")
def small_rows(tmp_path_factory):
    """A problem whose equality is in small units, one action without bounds and one with, and its controller."""
    s, u, p = ca.SX.sym("s"), ca.SX.sym("u", 2), ca.SX.sym("p")
    problem = OCP.from_expressions(
        state=s,
        action=u,
        parameters=p,
        horizon=3,
        dynamics=s + u[0] + u[1],
        stage_cost=(s - p) ** 2 + u[0] ** 2 + 2 * u[1] ** 2,
        path_equality=1e-3 * (u[0] - p * u[1]),
        action_bounds=([-np.inf, -9], [np.inf, 9]),
    )
    return problem, loaded(export_c(problem, Riccati(), tmp_path_factory.mktemp("small"), psi=[0.7]))


def test_gradients_do_not_depend_on_the_unit_of_an_equality(small_rows):
    """Its multiplier is found in proximal steps, the first of which leaves 1e-9 over the square of the unit."""
    problem, ours = small_rows
    plan = Riccati().solve(problem, [0.5], [0.7])
    slopes = np.ones((4, 1)), np.arange(6.0).reshape(3, 2)
    found, believed = ours.gradient(problem, [0.5], [0.7], (), plan, *slopes)
    expected = sensitivity(problem, plan).pull(*slopes)
    assert believed
    np.testing.assert_allclose(found.psi, expected.psi, rtol=1e-5)
    np.testing.assert_allclose(found.s0, expected.s0, rtol=1e-5)


@pytest.mark.parametrize(
    "bounds",
    [
        ([-np.inf, 2], [np.inf, 2]),
        ([-9, -9], [np.inf, 9]),
        ([-np.inf, -np.inf], [np.inf, 9]),
        ([-np.inf, -9], [np.inf, np.inf]),
    ],
    ids=str,
)
def test_bounds_that_are_finite_or_coincide_elsewhere_than_when_exported_are_refused(small_rows, bounds):
    problem, ours = small_rows
    moved = replace(problem, action_bounds=([-np.inf, -3], [np.inf, 2]))
    assert ours.solve(moved, [0.5], [0.7]).status is Status.CONVERGED
    with pytest.raises(ProblemError, match="bound"):
        ours.solve(replace(problem, action_bounds=bounds), [0.5], [0.7])
