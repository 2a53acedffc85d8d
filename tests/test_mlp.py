"""Networks in the CasADi graph: the numbers of torch, and derivatives that agree with AD and finite differences."""

from functools import partial
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.models.activations import ACTIVATIONS, SCALES
from kpirl_ocp.ocp.models.keypoint_dynamics import LinearisedNetwork, NetworkDynamics
from kpirl_ocp.ocp.models.mlp import (
    MLP,
    clearance,
    flatten_slopes,
    jacobian,
    jvp,
    kinked,
    unflatten_slopes,
    vjp,
    vjp_tangent,
)
from kpirl_ocp.ocp.models.mlp_hessian import prepare, second
from kpirl_ocp.ocp.problem.linearised_dynamics import LinearisedByStage

every_activation = pytest.mark.parametrize("activation", ACTIVATIONS)
PIECEWISE_LINEAR = ("identity", "leaky_relu", "relu")


def random_mlp(activation, widths=(9, 13, 6, 4), seed=0, output_activation="identity"):
    rng = np.random.default_rng(seed)
    pairs = list(pairwise(widths))
    weights = [rng.normal(size=(n_out, n_in)) / np.sqrt(n_in) for n_in, n_out in pairs]
    return MLP.from_layers(weights, [rng.normal(size=n) for _, n in pairs], activation, output_activation)


def function(mlp):
    x = ca.MX.sym("x", mlp.n_in)
    return ca.Function("mlp", [x], [mlp(x)])


def scalar_functions(activation):
    """sigma, sigma' and sigma'' of an activation as one CasADi function of many arguments."""
    a = ca.MX.sym("a", 1, 1)
    value, slopes = ACTIVATIONS[activation](a)
    first = ca.MX(1) if slopes.first is None else slopes.first
    second = ca.MX(0) if slopes.second is None else slopes.second
    f = ca.Function("jet", [a], [value, first, second])
    return lambda points: [np.array(f(x)[k]).item() for x in points for k in range(3)]


def assert_agree(found, expected, tolerance):
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(np.array(one), np.array(other), rtol=0, atol=tolerance)


# Activations


@every_activation
def test_activation_and_slope_are_those_of_torch(activation):
    torch = pytest.importorskip("torch")
    points = np.concatenate([np.linspace(-19.5, 19.5, 79), [-700.0, -40.0, 1e-9, -1e-9, 0.0]])
    x = torch.tensor(points, dtype=torch.float64, requires_grad=True)
    y = x * 1 if activation == "identity" else getattr(torch.nn.functional, activation)(x)
    (slope,) = torch.autograd.grad(y.sum(), x)
    found = np.array(scalar_functions(activation)(points)).reshape(-1, 3)
    np.testing.assert_allclose(found[:, 0], y.detach().numpy(), rtol=1e-12, atol=1e-300)
    # 1 - y^2 with y of almost 1, on either side right to a unit in its last place, 1.1e-16.
    np.testing.assert_allclose(found[:, 1], slope.numpy(), rtol=1e-12, atol=5e-16)


@every_activation
def test_slopes_are_the_derivatives_of_the_value(activation):
    """Central differences; the error of each falls like the step squared until rounding takes over."""
    points = np.array([-3.2, -0.7, 0.4, 2.9])
    middle = np.array(scalar_functions(activation)(points)).reshape(-1, 3)
    for order in (0, 1):
        errors = []
        for step in (1e-2, 1e-3, 1e-4):
            right, left = (np.array(scalar_functions(activation)(points + d)).reshape(-1, 3) for d in (step, -step))
            errors.append(np.abs((right - left)[:, order] / (2 * step) - middle[:, order + 1]).max())
        assert errors[1] <= max(0.02 * errors[0], 1e-11)
        assert errors[2] <= max(0.02 * errors[1], 1e-11)


@every_activation
def test_nan_stays_nan_and_huge_arguments_stay_exact(activation):
    evaluate = scalar_functions(activation)
    assert np.isnan(evaluate([np.nan])[0])
    value, slope, curvature = evaluate([800.0])
    assert value == pytest.approx(1.0 if activation in ("sigmoid", "tanh") else 800.0, rel=1e-15)
    assert slope == pytest.approx(0.0 if activation in ("sigmoid", "tanh") else 1.0, abs=1e-15)
    assert curvature == 0
    assert np.isfinite(evaluate([-800.0])).all()
    expected = {"identity": -np.inf, "leaky_relu": -np.inf, "elu": -1.0, "tanh": -1.0, "relu": np.nan, "silu": np.nan}
    np.testing.assert_equal(evaluate([-np.inf])[0], expected.get(activation, 0.0))


@pytest.mark.parametrize("activation", ["sigmoid", "softplus"])
def test_small_values_keep_their_relative_accuracy(activation):
    assert scalar_functions(activation)([-300.0]) == pytest.approx([np.exp(-300.0)] * 3, rel=1e-14)


# Networks


@every_activation
def test_network_equals_torch(activation):
    torch = pytest.importorskip("torch")
    kinds = {"identity": "Identity", "leaky_relu": "LeakyReLU", "relu": "ReLU", "silu": "SiLU", "elu": "ELU"}
    torch.manual_seed(0)
    layers = [torch.nn.Linear(29, 100), torch.nn.Linear(100, 25), torch.nn.Linear(25, 8)]
    between = getattr(torch.nn, kinds.get(activation, activation.capitalize()))
    model = torch.nn.Sequential(layers[0], between(), layers[1], between(), layers[2]).double()
    mlp = MLP.from_layers(
        [layer.weight.detach() for layer in layers], [layer.bias.detach() for layer in layers], activation
    )
    points = np.random.default_rng(0).normal(size=(5, 29))
    found = np.array(function(mlp).map(5)(points.T)).T
    np.testing.assert_allclose(found, model(torch.tensor(points)).detach().numpy(), rtol=0, atol=1e-14)
    x = torch.tensor(points[0], requires_grad=True)
    expected = torch.autograd.functional.jacobian(model, x).numpy()
    np.testing.assert_allclose(np.array(function(mlp).jacobian()(points[0], 0)), expected, rtol=0, atol=1e-14)


@every_activation
@pytest.mark.parametrize("output_activation", ["identity", "tanh"])
def test_hand_arranged_derivatives_are_those_of_ad(activation, output_activation):
    mlp = random_mlp(activation, output_activation=output_activation)
    x, dx, lam, dlam = (ca.MX.sym(name, n) for name, n in [("x", 9), ("dx", 9), ("lam", 4), ("dlam", 4)])
    y, slopes = mlp.linearise(x)
    slopes = unflatten_slopes(mlp, flatten_slopes(slopes))
    gradient = ca.gradient(ca.dot(lam, y), x)
    found = [
        jvp(mlp, slopes, dx)[0],
        vjp(mlp, slopes, lam)[0],
        vjp_tangent(mlp, vjp(mlp, slopes, lam)[2], jvp(mlp, slopes, dx)[1], dlam)[0],
        jacobian(mlp, slopes),
        second(mlp, prepare(mlp, slopes, lam))[1],
    ]
    expected = [
        ca.jtimes(y, x, dx),
        gradient,
        ca.jtimes(gradient, ca.vertcat(x, lam), ca.vertcat(dx, dlam)),
        ca.jacobian(y, x),
        ca.hessian(ca.dot(lam, y), x)[0],
    ]
    both = ca.Function("both", [x, dx, lam, dlam], found + expected)
    rng = np.random.default_rng(1)
    for _ in range(5):
        values = both(*[rng.normal(size=n) for n in (9, 9, 4, 4)])
        assert_agree(values[:5], values[5:], 2e-14)


@every_activation
def test_slopes_are_within_the_scales_of_an_activation(activation):
    """The third derivative by CasADi, which takes slopes at kinks for zero."""
    a = ca.SX.sym("a")
    _, slopes = ACTIVATIONS[activation](a)
    first, second = (a * 0 if part is None else part for part in (slopes.first, slopes.second))
    first = first if slopes.first is not None else first + 1
    points = np.linspace(-30, 30, 60001)[None]
    jet = ca.Function("jet", [a], [first, second, ca.gradient(second, a)])(points)
    found = [np.abs(np.array(part)).max() for part in jet]
    size, scale = SCALES[activation]
    bounds = size, size * scale, size * scale**2
    assert all(value <= bound for value, bound in zip(found, bounds, strict=True))
    tight = max(found[1] / size, np.sqrt(found[2] / size))
    assert found[0] > 0.99 * size
    assert scale == 0 or tight > 0.95 * scale


@every_activation
@pytest.mark.parametrize("steepness", [0.1, 1.0, 30.0])
def test_inputs_that_move_within_the_clearance_cross_no_kink_and_leave_jacobians_as_they_are(activation, steepness):
    mlp, rng = random_mlp(activation), np.random.default_rng(1)
    mlp = MLP((steepness * mlp.weights[0], *mlp.weights[1:]), mlp.biases, mlp.activations)
    x, sizes = rng.normal(size=9), rng.uniform(0.01, 2.0, 9)
    at = ca.MX.sym("x", 9)
    _, slopes = mlp.linearise(at)
    inner = ca.vertcat(ca.MX(0, 1), *kinked(slopes))
    evaluate = ca.Function("at", [at], [jacobian(mlp, slopes), inner])
    here, arguments = (part.full() for part in evaluate(x))
    allowed = float(ca.evalf(clearance(mlp, ca.MX(ca.DM(sizes)), ca.MX(ca.DM(np.abs(arguments))))))
    bound = np.eye(9)
    for weight, name in zip(mlp.weights, mlp.activations, strict=True):
        bound = SCALES[name][0] * np.abs(weight) @ bound
    moves = [*rng.uniform(-1, 1, (200, 9)), *rng.choice([-1.0, 1.0], (200, 9))]
    beside = [[part.full() for part in evaluate(x + 0.999 * min(allowed, 1.0) * move * sizes)] for move in moves]
    assert all((np.sign(there) == np.sign(arguments)).all() for _, there in beside)
    change = max(np.abs((there - here) / bound).max() for there, _ in beside)
    assert change <= 1e-3
    assert np.isfinite(allowed)
    assert allowed > 0


@every_activation
def test_the_clearance_of_several_points_is_that_of_each(activation):
    mlp, rng = random_mlp(activation), np.random.default_rng(1)
    x, moves = ca.MX.sym("x", 9, 3), rng.uniform(0.01, 2.0, (9, 3))
    nearest = [ca.fabs(arguments) for arguments in kinked(mlp.linearise(x)[1])]
    evaluate = ca.Function("nearest", [x], [ca.vertcat(ca.MX(0, 3), *nearest)])
    distances = evaluate(rng.normal(size=(9, 3)))
    together = ca.evalf(clearance(mlp, ca.MX(ca.DM(moves)), ca.MX(distances))).full()
    alone = [float(ca.evalf(clearance(mlp, ca.MX(ca.DM(moves[:, i])), ca.MX(distances[:, i])))) for i in range(3)]
    np.testing.assert_array_equal(together, [alone])
    assert len(set(alone)) == 3 or activation == "identity"


@every_activation
def test_columns_are_independent_points(activation):
    mlp = random_mlp(activation)
    x, dx, lam, dlam = (ca.MX.sym(name, n, 3) for name, n in [("x", 9), ("dx", 9), ("lam", 4), ("dlam", 4)])

    def everything(x, dx, lam, dlam):
        y, slopes = mlp.linearise(x)
        return [
            y,
            jvp(mlp, slopes, dx)[0],
            vjp(mlp, slopes, lam)[0],
            vjp_tangent(mlp, vjp(mlp, slopes, lam)[2], jvp(mlp, slopes, dx)[1], dlam)[0],
            *flatten_slopes(slopes),
        ]

    together = everything(x, dx, lam, dlam)
    apart = zip(*[everything(*[a[:, k] for a in (x, dx, lam, dlam)]) for k in range(3)], strict=True)
    both = ca.Function("both", [x, dx, lam, dlam], together + [ca.horzcat(*columns) for columns in apart])
    rng = np.random.default_rng(2)
    values = both(*[rng.normal(size=(n, 3)) for n in (9, 9, 4, 4)])
    assert_agree(values[: len(together)], values[len(together) :], 1e-15)


@pytest.mark.parametrize("activation", PIECEWISE_LINEAR)
def test_a_piecewise_linear_network_has_a_structurally_empty_hessian(activation):
    x = ca.MX.sym("x", 9)
    mlp = random_mlp(activation)
    assert second(mlp, prepare(mlp, mlp.linearise(x)[1], ca.MX.ones(4)))[1].nnz() == 0


def test_normalisation_is_folded_into_the_weights():
    rng, mlp = np.random.default_rng(3), random_mlp("tanh")
    mean_in, mean_out, x = rng.normal(size=9), rng.normal(size=4), rng.normal(size=9)
    scale_in, scale_out = rng.uniform(0.1, 5, 9), rng.uniform(0.1, 5, 4)
    expected = mean_out + scale_out * np.array(function(mlp)((x - mean_in) / scale_in)).ravel()
    folded = mlp.normalised(mean_in, scale_in, mean_out, scale_out)
    np.testing.assert_allclose(np.array(function(folded)(x)).ravel(), expected, rtol=0, atol=2e-14)


@pytest.mark.parametrize(
    ("build", "reason"),
    [
        (lambda: MLP((), (), ()), "one weight, bias and activation per layer"),
        (lambda: MLP((np.ones((2, 3)),), (np.ones(3),), ("relu",)), r"layer 0 must have a weight \(n, 3\) and a bias"),
        (lambda: MLP.from_layers([np.ones((2, 3)), np.ones((1, 4))], [np.ones(2), np.ones(1)]), "layer 1 must have"),
        (lambda: MLP((np.full((2, 3), np.nan),), (np.ones(2),), ("relu",)), "layer 0 holds NaN"),
        (lambda: random_mlp("gelu"), "must be one of elu, identity, .*; got 'gelu'"),
        (lambda: random_mlp("relu", output_activation="tanh").normalised(0, 1, 0, 1), "linear last layer, not 'tanh'"),
        (lambda: random_mlp("relu").normalised(np.zeros(8), 1, 0, 1), "mean_in must be 9 finite numbers"),
        (lambda: random_mlp("relu").normalised(*map(np.zeros, (9, 9, 4, 4))), "must be positive"),
        (lambda: NetworkDynamics(random_mlp("relu"), 4, 2), "need a network with 10 inputs and 4 outputs; it has 9"),
    ],
)
def test_a_network_that_does_not_fit_is_refused(build, reason):
    with pytest.raises(ProblemError, match=reason):
        build()


# Dynamics


def random_dynamics(activation, residual=True, rate=None):
    return NetworkDynamics(random_mlp(activation, (4 + 3 * 2, 12, 7, 4)), 4, 2, residual, rate)


@pytest.mark.parametrize("residual", [True, False])
def test_next_state_is_the_formula_of_the_appendix(residual):
    dynamics, rng = random_dynamics("silu", residual), np.random.default_rng(4)
    z, theta, velocity, u = (rng.normal(size=n) for n in (4, 2, 2, 2))
    y = np.array(function(dynamics.mlp)(np.concatenate([z, theta, velocity, u]))).ravel()
    expected = np.concatenate([residual * z + y, theta + u, velocity])
    found = dynamics.function(3)(dynamics.state(z, theta, velocity), u, np.zeros(3))
    np.testing.assert_allclose(np.array(found).ravel(), expected, rtol=0, atol=1e-15)


@every_activation
@pytest.mark.parametrize("residual", [True, False])
def test_linearised_dynamics_are_those_of_ad(activation, residual):
    dynamics, rng, points = random_dynamics(activation, residual), np.random.default_rng(5), 3
    inputs = [rng.normal(size=(n, points)) for n in (8, 2, 0, 8, 10, 8)]
    S, U, psi, Lambda, x, dLambda = symbols = [ca.MX.sym("x", *array.shape) for array in inputs]
    found, expected = (
        ca.Function("linearised", symbols, everything(linearise(S, U, psi, Lambda), x, dLambda)).call(inputs)
        for linearise in (partial(LinearisedNetwork, dynamics), partial(LinearisedByStage, dynamics.function(3)))
    )
    assert_agree([m.full() for m in found], [m.full() for m in expected], 2e-14)


def everything(at, x, dcostates):
    """All that dynamics linearised at some points know."""
    function, arguments = at.second()
    second = function.map(x.size2()).call(arguments)
    return [at.value, at.Ft_lambda, at.Ft_lambda_tangent(x, dcostates), *second]


def test_a_state_of_another_shape_is_refused():
    with pytest.raises(ProblemError, match=r"4 keypoint coordinates and 2 joint positions, got shapes \(3,\)"):
        random_dynamics("relu").state(np.zeros(3), np.zeros(2))
