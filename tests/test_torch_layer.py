"""An OCP as a layer in PyTorch: trajectories of the solver, gradients that gradcheck believes, nothing silent."""

import copy
import importlib.util
import pickle
import re
import subprocess
import sys
import threading
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from problems import CASES

from kpirl_ocp import OCP, Implicit, Ipopt, Riccati, sensitivity
from kpirl_ocp.errors import CertificateError, ProblemError, SolveError
from kpirl_ocp.irl.hypergradients.loss import squared_distance

torch = pytest.importorskip("torch")
from kpirl_ocp.bridges.torch_layer import OCPLayer  # noqa: E402

COUNT = 3


def batch(name, dtype=torch.float64, count=COUNT):
    """psi, s0 and context of instances near a case, as tensors with gradients."""
    case, rng = CASES[name](), np.random.default_rng(0)
    given = (case.psi, case.demonstration.s0, case.demonstration.context)
    spread = [np.asarray(x) * (1 + 0.02 * rng.normal(size=(count, np.size(x)))) for x in given]
    return case.problem, [torch.tensor(x, dtype=dtype, requires_grad=True) for x in spread]


@pytest.mark.parametrize("name", ["lqr", "pendulum", "integrator"])
def test_the_layer_gives_the_solutions_of_the_solver(name):
    problem, inputs = batch(name)
    plan = OCPLayer(problem)(*inputs)
    assert plan.states.shape == (COUNT, problem.horizon + 1, problem.n_states)
    assert plan.actions.shape == (COUNT, problem.horizon, problem.n_actions)
    assert plan.solved.all()
    assert len(repr(plan)) < 300
    for index, (psi, s0, context) in enumerate(zip(*(x.detach().numpy() for x in inputs), strict=True)):
        alone = Riccati().solve(problem, s0, psi, context)
        np.testing.assert_allclose(plan.states[index].detach(), alone.states, rtol=0, atol=1e-12)
        np.testing.assert_allclose(plan.actions[index].detach(), alone.actions, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ["lqr", "pendulum", "integrator"])
def test_gradcheck_believes_the_gradients_by_parameters_start_and_context(name):
    problem, (psi, s0, context) = batch(name, count=2)
    layer = OCPLayer(problem, Riccati(tolerance=1e-12))

    def plan(*given):
        found = layer(*given) if context.numel() else layer(*given, context)
        return found.states, found.actions, found.values

    inputs = (psi, s0, context) if context.numel() else (psi, s0)
    assert torch.autograd.gradcheck(plan, inputs, eps=1e-6, atol=1e-5, rtol=1e-5)


def two_steps():
    """min psi u_0^2 + psi u_1^2 + s_2^2 with s+ = s + u, of which all is known; two instances."""
    s, u, psi = ca.SX.sym("s"), ca.SX.sym("u"), ca.SX.sym("psi")
    problem = OCP.from_expressions(
        state=s, action=u, parameters=psi, horizon=2, dynamics=s + u, stage_cost=psi * u**2, terminal_cost=s**2,
        action_bounds=(-1, 1),
    )  # fmt: skip
    psi, s0 = torch.tensor([[0.5], [2.0]]).double(), torch.tensor([[1.0], [-0.7]]).double()
    return problem, psi.requires_grad_(), s0.requires_grad_()


def test_values_and_their_gradients_are_those_of_the_closed_form():
    problem, psi, s0 = two_steps()
    exact = psi * s0**2 / (psi + 2)
    values = OCPLayer(problem)(psi, s0).values
    np.testing.assert_allclose(values.detach(), exact.detach().ravel(), rtol=1e-9)
    found, expected = (torch.autograd.grad(v.sum(), (psi, s0)) for v in (values, exact))
    for one, two in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-8)


def test_values_of_a_given_first_action_and_their_gradients_are_those_of_the_closed_form():
    problem, psi, s0 = two_steps()
    u0 = torch.tensor([[0.3], [3.0]], dtype=torch.float64, requires_grad=True)  # the second one beyond its bound
    s1 = s0 + u0
    exact = psi * u0**2 + torch.where(s1.abs() < 1 + psi, psi * s1**2 / (1 + psi), psi + (s1.abs() - 1) ** 2)
    plan = OCPLayer(problem)(psi, s0, u0=u0)
    np.testing.assert_allclose(plan.actions[:, 0].detach(), u0.detach(), atol=1e-12)
    np.testing.assert_allclose(plan.values.detach(), exact.detach().ravel(), rtol=1e-9)
    found, expected = (torch.autograd.grad(v.sum(), (psi, s0, u0)) for v in (plan.values, exact))
    for one, two in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-8)


def test_a_value_of_the_smoothed_problem_has_the_gradient_of_differences():
    problem, psi, s0 = two_steps()
    layer = OCPLayer(problem, Riccati(tolerance=1e-12), policy="smooth", barrier=1e-2)
    assert torch.autograd.gradcheck(lambda *given: layer(*given).values, (psi, s0), eps=1e-5, atol=1e-6, rtol=1e-6)


def test_a_masked_value_has_no_gradient_at_all():
    """Not even the slope of the cost by psi at a fixed plan, which is there for any plan."""
    problem, psi, s0 = weakly_active()
    plan = OCPLayer(problem, policy="mask")(psi, s0)
    plan.values.sum().backward()
    assert [c.certified for c in plan.certificates[0]] == [True, False]
    assert psi.grad[1] == 0
    with torch.no_grad():
        psi[1] = torch.nan
    values = OCPLayer(problem, policy="mask")(psi, s0).values
    assert torch.autograd.grad(values.sum(), psi)[0][1] == 0


def test_the_jacobian_of_the_first_action_is_that_of_the_sensitivity():
    problem, (psi, s0, context) = batch("pendulum")
    layer = OCPLayer(problem)
    jacobian = torch.autograd.functional.jacobian(lambda p: layer(p, s0, context).actions[:, 0], psi)
    for index, solution in enumerate(layer(psi, s0, context).solutions):
        one = torch.eye(problem.horizon, problem.n_actions).double().numpy()
        expected = sensitivity(problem, solution).pull(np.zeros_like(solution.states), one).psi
        np.testing.assert_allclose(jacobian[index, 0, index], expected, rtol=1e-8)


def test_the_gradient_of_the_irl_loss_is_the_implicit_hypergradient():
    case = CASES["pendulum"]()
    problem, seen = case.problem, torch.tensor(case.demonstration.observations)
    assert problem.observation is None
    psi = torch.tensor(case.psi, requires_grad=True)
    plan = OCPLayer(problem)(psi, torch.tensor(case.demonstration.s0), torch.tensor(case.demonstration.context))
    loss = ((plan.states[0] - seen) ** 2).sum()
    loss.backward()
    expected = Implicit(loss=squared_distance)(problem, case.demonstration, case.psi)
    assert loss.item() == pytest.approx(expected.loss, rel=1e-12)
    np.testing.assert_allclose(psi.grad, expected.gradient, rtol=1e-9)


def test_single_precision_comes_out_as_single_precision_of_the_same_numbers():
    problem, inputs = batch("pendulum", torch.float32)
    plan = OCPLayer(problem)(*inputs)
    assert plan.states.dtype == plan.actions.dtype == torch.float32
    plan.actions.square().sum().backward()
    exact = [x.detach().double().requires_grad_() for x in inputs]
    OCPLayer(problem)(*exact).actions.square().sum().backward()
    for single, double in zip(inputs, exact, strict=True):
        assert single.grad.dtype == torch.float32
        np.testing.assert_allclose(single.grad, double.grad, rtol=1e-5, atol=1e-6)


def test_what_holds_for_all_instances_is_given_once_and_its_gradient_is_the_sum():
    problem, (psi, s0, context) = batch("pendulum")
    shared = psi[0].detach().requires_grad_()
    layer = OCPLayer(problem)
    layer(shared, s0, context).actions.sum().backward()
    repeated = shared.detach().expand(COUNT, -1).clone().requires_grad_()
    layer(repeated, s0, context).actions.sum().backward()
    np.testing.assert_allclose(shared.grad, repeated.grad.sum(0), rtol=1e-9)


@pytest.mark.parametrize("threads", [1, 3])
def test_any_number_of_threads_gives_the_same_numbers(threads):
    problem, inputs = batch("pendulum", count=7)
    plan, other = OCPLayer(problem, threads=threads)(*inputs), OCPLayer(problem, threads=2)(*inputs)
    assert torch.equal(plan.states, other.states)
    gradients = [torch.autograd.grad(p.actions.square().sum(), inputs) for p in (plan, other)]
    for one, two in zip(*gradients, strict=True):
        assert torch.equal(one, two)


class Meeting:
    """A solver that begins once as many threads as there are instances are here, or fails."""

    def __init__(self, count):
        self.everyone = threading.Barrier(count)

    def solve(self, *given):
        self.everyone.wait(timeout=60)
        return Riccati().solve(*given)


def test_instances_of_a_batch_are_solved_at_the_same_time():
    problem, inputs = batch("pendulum", count=4)
    assert OCPLayer(problem, Meeting(4), threads=4)(*inputs).solved.all()


def test_a_former_plan_is_a_guess():
    problem, inputs = batch("pendulum")
    layer = OCPLayer(problem)
    cold = layer(*inputs)
    warm = layer(*inputs, guess=cold)
    for first, second in zip(cold.solutions, warm.solutions, strict=True):
        assert second.iterations < first.iterations
    np.testing.assert_allclose(warm.actions.detach(), cold.actions.detach(), atol=1e-9)


def test_a_plan_is_a_guess_for_one_with_a_given_first_action_and_back():
    problem, psi, s0 = two_steps()
    layer = OCPLayer(problem)
    plan = layer(psi, s0)
    given = layer(psi, s0, u0=plan.actions[:, 0].detach(), guess=plan)
    np.testing.assert_allclose(given.values.detach(), plan.values.detach(), rtol=1e-9)
    again = layer(psi, s0, u0=plan.actions[:, 0].detach(), guess=given)
    assert all(s.iterations <= t.iterations for s, t in zip(again.solutions, given.solutions, strict=True))
    np.testing.assert_allclose(layer(psi, s0, guess=given).values.detach(), plan.values.detach(), rtol=1e-9)


def weakly_active():
    """The second of two instances, min (u - psi)^2 with u <= 1, stands just at its bound at psi = 1."""
    s, u, psi = ca.SX.sym("s"), ca.SX.sym("u"), ca.SX.sym("psi")
    problem = OCP.from_expressions(
        state=s, action=u, parameters=psi, horizon=1, dynamics=s + u, stage_cost=(u - psi) ** 2, action_bounds=(-1, 1)
    )
    return problem, torch.tensor([[0.5], [1.0]], dtype=torch.float64, requires_grad=True), torch.zeros(2, 1).double()


def test_a_gradient_that_is_not_certified_raises():
    problem, psi, s0 = weakly_active()
    plan = OCPLayer(problem)(psi, s0)
    with pytest.raises(CertificateError, match="weakly active"):
        plan.actions.sum().backward()


def test_a_masked_gradient_is_left_out_and_says_so():
    problem, psi, s0 = weakly_active()
    plan = OCPLayer(problem, policy="mask")(psi, s0)
    assert plan.certificates == []
    plan.actions.sum().backward()
    np.testing.assert_allclose(psi.grad, [[1.0], [0.0]], atol=1e-9)
    (certificates,) = plan.certificates
    assert [c.certified for c in certificates] == [True, False]
    assert "weakly active" in str(certificates[1])


@pytest.mark.parametrize("solver", [Riccati(), Ipopt()], ids=["Riccati", "Ipopt"])
def test_a_smoothed_gradient_is_that_of_the_smoothed_problem(solver):
    problem, psi, s0 = weakly_active()
    tau = 1e-2
    plan = OCPLayer(problem, solver, policy="smooth", barrier=tau)(psi, s0)
    plan.actions.sum().backward()
    for p, u, slope in zip(psi.detach(), plan.actions.detach().ravel(), psi.grad.ravel(), strict=True):
        assert abs(2 * (u - p) + tau / (1 - u) - tau / (1 + u)) < 1e-6
        curvature = 2 + tau / (1 - u) ** 2 + tau / (1 + u) ** 2
        assert slope.item() == pytest.approx(2 / curvature.item(), rel=1e-5)


@pytest.mark.parametrize("again", [copy.deepcopy, lambda layer: pickle.loads(pickle.dumps(layer))])
def test_a_layer_that_has_solved_can_be_copied_and_saved(again):
    """As target networks in reinforcement learning are copied, and `torch.save` saves a whole module."""
    problem, psi, s0 = two_steps()
    layer = OCPLayer(problem)
    plan = layer(psi, s0)
    assert torch.equal(again(torch.nn.Sequential(layer))[0](psi, s0).actions, plan.actions)


def test_a_failed_solve_raises_or_is_masked():
    problem, inputs = batch("pendulum")
    with torch.no_grad():
        inputs[0][1] = torch.nan
    with pytest.raises(SolveError, match="1 of 3 solves failed; number 1: NOT_FINITE"):
        OCPLayer(problem)(*inputs)
    plan = OCPLayer(problem, policy="mask")(*inputs)
    assert plan.solved.tolist() == [True, False, True]
    plan.actions[0].sum().backward()
    assert inputs[0].grad[0].abs().sum() > 0
    assert (inputs[0].grad[1] == 0).all()
    assert [c.certified for c in plan.certificates[0]] == [True, False, True]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda psi, s0, context: (psi[:, 1:], s0, context), r"psi must be \(2,\) or \(3, 2\)"),
        (lambda psi, s0, context: (psi[:2], s0, context), "psi must be"),
        (lambda psi, s0, context: (psi, s0[0, :1], context), "s0 must be"),
        (lambda psi, s0, context: (psi, s0.long(), context), "floating-point"),
    ],
)
def test_shapes_that_do_not_fit_are_refused(change, reason):
    problem, inputs = batch("pendulum")
    with pytest.raises(ProblemError, match=reason):
        OCPLayer(problem)(*change(*inputs))


def test_settings_that_do_not_fit_are_refused():
    problem, inputs = batch("pendulum")
    with pytest.raises(ProblemError, match="policy must be one of raise, mask, smooth"):
        OCPLayer(problem, policy="flag")
    with pytest.raises(ProblemError, match="needs barrier > 0"):
        OCPLayer(problem, policy="smooth", barrier=0.0)
    with pytest.raises(ProblemError, match="as many guesses"):
        OCPLayer(problem)(*inputs, guess=[None])


def test_a_network_upstream_learns_what_the_cost_depends_on():
    """The target of a tracking cost is a hidden function of a feature; demonstrated actions teach it."""
    s, u, target = ca.SX.sym("s"), ca.SX.sym("u"), ca.SX.sym("target")
    problem = OCP.from_expressions(
        state=s, action=u, parameters=target, horizon=8, dynamics=s + u, stage_cost=(s - target) ** 2 + u**2,
        terminal_cost=(s - target) ** 2, action_bounds=(-0.4, 0.4),
    )  # fmt: skip
    torch.manual_seed(0)
    layer, features = OCPLayer(problem, policy="mask"), torch.linspace(-1, 1, 12).double()[:, None]
    start = torch.zeros(12, 1).double()
    with torch.no_grad():
        wanted = layer(torch.sin(2 * features), start).actions
    network = torch.nn.Sequential(torch.nn.Linear(1, 16), torch.nn.Tanh(), torch.nn.Linear(16, 1)).double()
    optimiser = torch.optim.Adam(network.parameters(), lr=0.05)
    losses = []
    for _ in range(200):
        optimiser.zero_grad()
        loss = (layer(network(features), start).actions - wanted).square().mean()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.01 * losses[0]


def test_the_published_imitation_task_is_solved(tmp_path):
    """From all of the 20 starts."""
    script = Path(__file__).parents[1] / "scripts" / "imitate_expert.py"
    command = [sys.executable, script, "--out", tmp_path]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    errors = [float(error) for error in re.findall(r"error of the weights ([\d.e+-]+)", ran.stdout)]
    assert len(errors) == 20
    assert max(errors) < 1e-3


def test_the_expert_ends_in_no_minimum_of_many_turns():
    """From the published lines: where no length of a lifted step is accepted, steps along the dynamics go on."""
    script = Path(__file__).parents[1] / "scripts" / "experiments" / "imitate_expert.py"
    spec = importlib.util.spec_from_file_location("imitate_expert", script)
    imitation = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = imitation  # where its records look for their annotations
    spec.loader.exec_module(imitation)
    layer = OCPLayer(imitation.cart_pole(), Riccati(max_iterations=2000))
    plans = imitation.demonstrate(layer, imitation.starting_states())
    assert max(solution.objective for solution in plans.solutions) < 4e4


class Plans(torch.utils.data.Dataset):
    """First actions from shifted starts, solved in the workers of a loader."""

    def __init__(self, problem, *numbers):
        self.problem, self.numbers = problem, numbers

    def __len__(self):
        return 3

    def __getitem__(self, index):
        s0, *rest = self.numbers
        return Riccati().solve(self.problem, s0 + 0.01 * index, *rest).actions[0]


@pytest.mark.filterwarnings("ignore:.*fork:RuntimeWarning", "ignore:.*fork:DeprecationWarning")  # JAX, of other tests
@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_workers_of_a_data_loader_solve_as_their_parent_does(context):
    case = CASES["pendulum"]()
    plans = Plans(case.problem, np.asarray(case.demonstration.s0), case.psi, case.demonstration.context)
    loaded = torch.utils.data.DataLoader(plans, batch_size=None, num_workers=1, multiprocessing_context=context)
    np.testing.assert_array_equal(list(map(np.asarray, loaded)), [plans[index] for index in range(3)])


def test_jax_is_not_imported_with_the_layer():
    code = "import sys; from kpirl_ocp.bridges import OCPLayer; print('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "False\n"
