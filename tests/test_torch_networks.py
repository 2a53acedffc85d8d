"""Networks as people have them: the numbers of torch, whichever way they come."""

import copy
import logging
from functools import cache
from importlib import import_module

import casadi as ca
import numpy as np
import pytest

from kpirl_ocp import OCP, Demonstration, Implicit, Riccati
from kpirl_ocp.errors import ModelError, ProblemError
from kpirl_ocp.ocp.models import MLP, NetworkDynamics, load_onnx
from kpirl_ocp.ocp.models.graph_network import GraphNetwork

torch = pytest.importorskip("torch")
pytest.importorskip("onnx")
from kpirl_ocp.bridges.torch_network import from_torch  # noqa: E402

nn = torch.nn
WIDTH = 12


@pytest.fixture(scope="module", autouse=True)
def library():
    """torch reads its library of a thousand operators, which no export changes, once, and not again in every export."""
    registry = import_module("torch.onnx._internal.exporter._registration").ONNXRegistry
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "from_torchlib", staticmethod(cache(registry.from_torchlib)))
        yield


class Normalised(nn.Module):
    """Normalisation of inputs and outputs inside the module."""

    def __init__(self):
        super().__init__()
        self.register_buffer("mean", torch.randn(5))
        self.register_buffer("deviation", torch.rand(5) + 0.5)
        self.net = nn.Sequential(nn.Linear(5, WIDTH), nn.Tanh(), nn.Linear(WIDTH, 4))
        self.shift, self.scale = nn.Parameter(torch.randn(4)), nn.Parameter(torch.rand(4) + 0.5)

    def forward(self, x):
        return self.net((x - self.mean) / self.deviation) * self.scale + self.shift


class StateAndAction(nn.Module):
    """x + net(cat([x, u])), or without the x."""

    def __init__(self, residual):
        super().__init__()
        self.residual = residual
        self.net = nn.Sequential(nn.Linear(5, WIDTH), nn.SiLU(), nn.Linear(WIDTH, 4))

    def forward(self, x, u):
        change = self.net(torch.cat([x, u], dim=-1))
        return x + change if self.residual else change


class Block(nn.Module):
    """A pre-norm residual block."""

    def __init__(self):
        super().__init__()
        self.f = nn.Sequential(nn.LayerNorm(WIDTH), nn.Linear(WIDTH, 2 * WIDTH), nn.GELU(), nn.Linear(2 * WIDTH, WIDTH))

    def forward(self, x):
        return x + self.f(x)


class Parameters(nn.Module):
    """Weights that are bare parameters."""

    def __init__(self):
        super().__init__()
        self.w, self.b = nn.Parameter(torch.randn(5, WIDTH)), nn.Parameter(torch.randn(WIDTH))
        self.v = nn.Parameter(torch.randn(WIDTH, 4))

    def forward(self, x):
        return torch.tanh(x @ self.w + self.b) @ self.v


class Angles(nn.Module):
    """Features that people compute on the way in."""

    def __init__(self):
        super().__init__()
        self.net = nn.Linear(7, 4)

    def forward(self, x):
        q, v = x[:, :3], x[:, 3:]
        return self.net(torch.cat([torch.sin(q), torch.cos(q), v.sum(-1, keepdim=True)], -1)) * v.mean(-1, keepdim=True)


def around(*layers):
    return nn.Sequential(nn.Linear(5, WIDTH), *layers, nn.Linear(WIDTH, 4))


def batch_norm(*after):
    layer = nn.BatchNorm1d(WIDTH)
    layer.running_mean.normal_()
    layer.running_var.uniform_(0.5, 2)
    nn.init.normal_(layer.weight)
    nn.init.normal_(layer.bias)
    return around(*after, layer, nn.ReLU())


class Value(nn.Module):
    """One number, of shape (1,)."""

    def __init__(self):
        super().__init__()
        self.net = nn.Linear(5, 1)

    def forward(self, x):
        return self.net(x).squeeze(-1)


class Cell(nn.Module):
    """One step of a recurrent network: input (2,) and state (3,) to the next state."""

    def __init__(self):
        super().__init__()
        self.cell = nn.GRUCell(2, 3)

    def forward(self, x):
        return self.cell(x[:, :2], x[:, 2:])


CHAINS = {  # each becomes an MLP
    "linear": lambda: nn.Linear(5, 4),
    "ReLU": lambda: around(nn.ReLU()),
    "two hidden layers": lambda: around(nn.Tanh(), nn.Linear(WIDTH, WIDTH), nn.Sigmoid()),
    "LeakyReLU": lambda: around(nn.LeakyReLU()),
    "ELU": lambda: around(nn.ELU()),
    "SiLU": lambda: around(nn.SiLU()),
    "Softplus": lambda: around(nn.Softplus()),
    "Dropout": lambda: around(nn.ReLU(), nn.Dropout(0.5)),
    "BatchNorm after a layer": batch_norm,
    "BatchNorm after an activation": lambda: batch_norm(nn.Tanh()),
    "normalisation": Normalised,
    "parameters": Parameters,
    "output activation": lambda: nn.Sequential(nn.Linear(5, 4), nn.Tanh()),
}
GRAPHS = {  # these go through CasADi's reader
    "cat([x, u])": lambda: StateAndAction(residual=False),
    "x + net(x, u)": lambda: StateAndAction(residual=True),
    "residual blocks": lambda: around(Block(), Block(), nn.LayerNorm(WIDTH)),
    "features": Angles,
    "GELU": lambda: around(nn.GELU()),
    "GELU by tanh": lambda: around(nn.GELU(approximate="tanh")),
    "LeakyReLU of slope 0.2": lambda: around(nn.LeakyReLU(0.2)),
    "ReLU6": lambda: around(nn.ReLU6()),
    "Softplus with beta": lambda: around(nn.Softplus(beta=2.0)),
    "ELU with alpha": lambda: around(nn.ELU(0.5)),
    "Mish": lambda: around(nn.Mish()),
    "PReLU": lambda: around(nn.PReLU()),
    "Hardswish": lambda: around(nn.Hardswish()),
    "LayerNorm": lambda: around(nn.LayerNorm(WIDTH), nn.Tanh()),
    "LayerNorm without weights": lambda: around(nn.LayerNorm(WIDTH, elementwise_affine=False), nn.Tanh()),
    "BatchNorm and GELU": lambda: around(nn.GELU(), nn.BatchNorm1d(WIDTH)),
    "RMSNorm": lambda: around(nn.RMSNorm(WIDTH)),
    "Softmax": lambda: around(nn.Softmax(dim=-1)),
    "a value without an axis": Value,
    "GRUCell": Cell,
}
WITHOUT_OLD_EXPORTER = {"RMSNorm"}  # torch's TorchScript exporter does not know it


def build(name):
    torch.manual_seed(0)
    return (CHAINS | GRAPHS)[name]().eval()


def inputs(module, seed=0):
    generator = torch.Generator().manual_seed(seed)
    sizes = (4, 1) if isinstance(module, StateAndAction) else (5,)
    return tuple(torch.randn(1, size, generator=generator, dtype=torch.float64) for size in sizes)


def export(module, path, dynamo):
    options = {"dynamo": True, "verbose": False} if dynamo else {"dynamo": False}
    torch.onnx.export(module, tuple(x.float() for x in inputs(module)), str(path), **options)
    return path


def check_equal(network, module, tolerance):
    exact = copy.deepcopy(module).double()
    for seed in range(3):
        given = inputs(module, seed)
        symbols = [ca.MX.sym("x", x.shape[1]) for x in given]
        evaluate = ca.Function("f", symbols, [network(ca.vertcat(*symbols))])
        found = np.array(evaluate(*(x.numpy().ravel() for x in given))).ravel()
        np.testing.assert_allclose(found, exact(*given).detach().numpy().ravel(), rtol=0, atol=tolerance)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("dynamo", [False, True], ids=["TorchScript", "dynamo"])
@pytest.mark.parametrize("name", [*CHAINS, *GRAPHS])
def test_a_network_that_torch_exported_has_the_numbers_of_torch(tmp_path, name, dynamo):
    if dynamo:
        pytest.importorskip("onnxscript")
    elif name in WITHOUT_OLD_EXPORTER:
        pytest.skip("not known to this exporter")
    module = build(name)
    network = load_onnx(export(module, tmp_path / "network.onnx", dynamo))
    assert isinstance(network, MLP if name in CHAINS else MLP | GraphNetwork)
    check_equal(network, module, 1e-6)


@pytest.mark.parametrize("name", ["normalisation", "x + net(x, u)", "residual blocks", "BatchNorm and GELU", "RMSNorm"])
def test_a_torch_module_keeps_its_numbers_to_rounding(name):
    pytest.importorskip("onnxscript")
    module = build(name)
    before = {key: value.clone() for key, value in module.state_dict().items()}
    check_equal(
        from_torch(module, *(x.shape[1] for x in inputs(module))), module, 1e-11
    )  # ONNX keeps epsilon in float32
    assert all(torch.equal(value, before[key]) for key, value in module.state_dict().items())


class Recurrent(nn.Module):
    """A recurrent network of one step."""

    def __init__(self):
        super().__init__()
        self.gru = nn.GRU(3, WIDTH, batch_first=True)

    def forward(self, x):
        return self.gru(x[:, None])[0][:, -1]


class Branching(nn.Module):
    """Another function on each side of x_0 = 0."""

    def forward(self, x):
        return x if x[0, 0] > 0 else -x


class Convolution(nn.Module):
    """A row of numbers as a signal of one channel."""

    def __init__(self):
        super().__init__()
        self.conv = nn.Conv1d(1, 2, 3)

    def forward(self, x):
        return self.conv(x[:, None]).flatten(1)


LENGTHS = "from_torch needs the length of every input of forward, whole numbers of at least 1"
NOT_READ = "the graph is no chain of layers, and CasADi cannot read it: "
REFUSED_MODULES = {  # a module, lengths, the beginning of the sentence
    "wrong length": (
        lambda: nn.Sequential(nn.Linear(5, 4)),
        (3,),
        "Sequential does not run on float64 zeros of (1, 3): RuntimeError: mat1 and mat2 shapes cannot be multiplied "
        "(1x3 and 5x4). from_torch needs the length of every input of its forward.",
    ),
    "wrong number of inputs": (
        lambda: nn.Linear(5, 4),
        (4, 1),
        "Linear does not run on float64 zeros of (1, 4), (1, 1): TypeError: ",
    ),
    "no length": (lambda: nn.Linear(5, 4), (), f"{LENGTHS}, as in from_torch(module, 2, 1)"),
    "a length that is no whole number": (lambda: nn.Linear(5, 4), (5.0,), LENGTHS),
    "a negative length": (lambda: nn.Linear(5, 4), (-5,), LENGTHS),
    "a shape for a length": (lambda: nn.Linear(5, 4), ((1, 5),), LENGTHS),
    "a class": (
        lambda: Recurrent,
        (3,),
        "from_torch needs a torch.nn.Module with its weights, got the class Recurrent.",
    ),
    "a state_dict": (lambda: nn.Linear(5, 4).state_dict(), (5,), "from_torch needs a torch.nn.Module with its weights"),
    "two tensors": (
        lambda: nn.LSTMCell(3, 4),
        (3,),
        "the forward of LSTMCell must return one tensor (1, n_out), got tuple: wrap it in a module that returns",
    ),
    "a branch": (Branching, (3,), "torch runs Branching, but cannot export it: GuardOnDataDependentSymNode: "),
    "GRU over a sequence": (
        Recurrent,
        (3,),
        f"Recurrent: {NOT_READ}Unsupported operation 'GRU'. Write one step of it with nn.GRUCell, nn.LSTMCell or "
        "nn.RNNCell, whose state is an input and an output.",
    ),
    "convolution": (
        Convolution,
        (5,),
        f"Convolution: {NOT_READ}Unsupported operation 'Conv'. It has values of 3 axes: write it with values of the "
        "shape (1, n).",
    ),
}


@pytest.mark.parametrize("case", REFUSED_MODULES)
def test_a_module_that_cannot_be_read_is_refused_in_one_sentence_without_logs(case, capfd):
    pytest.importorskip("onnxscript")
    module, sizes, sentence = REFUSED_MODULES[case]
    with pytest.raises(ModelError) as refused:
        from_torch(module(), *sizes)
    assert str(refused.value).startswith(sentence)
    assert len(str(refused.value)) < 400
    assert "\n" not in str(refused.value)
    assert capfd.readouterr() == ("", "")


def test_the_logs_of_others_are_shown_after_an_export():
    with pytest.raises(ModelError):
        from_torch(nn.Linear(5, 4), 3)
    log, seen = logging.getLogger("of the user"), []
    log.addFilter(lambda record: seen.append(record.getMessage()))
    log.warning("seen")
    assert seen == ["seen"]
    assert logging.root.manager.disable == logging.NOTSET


@pytest.mark.filterwarnings("ignore")
def test_a_dynamic_batch_axis_is_one_point(tmp_path):
    module, path = build("ReLU"), tmp_path / "network.onnx"
    torch.onnx.export(
        module, torch.zeros(3, 5), str(path), dynamo=False, input_names=["x"], dynamic_axes={"x": {0: "batch"}}
    )
    check_equal(load_onnx(path), module, 1e-6)


@pytest.mark.filterwarnings("ignore")
def test_an_operator_that_nobody_knows_is_named(tmp_path):
    class Odd(nn.Module):
        def forward(self, x):
            return torch.round(x)

    torch.onnx.export(Odd(), torch.zeros(1, 5), str(tmp_path / "odd.onnx"), dynamo=False)
    with pytest.raises(ModelError, match=r"odd\.onnx: .*CasADi cannot read it: Unsupported operation 'Round'"):
        load_onnx(tmp_path / "odd.onnx")


@pytest.mark.filterwarnings("ignore")
def test_columns_are_points():
    pytest.importorskip("onnxscript")
    network = from_torch(build("x + net(x, u)"), 4, 1)
    x, u = ca.MX.sym("x", 4, 3), ca.MX.sym("u", 1, 3)
    points = np.random.default_rng(0).normal(size=(5, 3))
    together = np.array(ca.Function("f", [x, u], [network(x, u)])(points[:4], points[4:]))
    alone = [np.array(network.function(point[:4], point[4:])).ravel() for point in points.T]
    np.testing.assert_allclose(together.T, alone, rtol=0, atol=1e-15)


def two_inputs():
    x, h = ca.MX.sym("x", 3), ca.MX.sym("h", 4)
    return GraphNetwork(ca.Function("f", [x, h], [ca.vertcat(x, 2 * h)]))


def one_input():
    return MLP([np.eye(2, 3)], [np.zeros(2)], ["identity"])


WRONG_INPUTS = {  # a network, inputs, what is said
    "lengths that add up": (
        two_inputs,
        (2, 5),
        r"the network takes inputs of lengths \(3, 4\), got lengths \(2, 5\)\.",
    ),
    "parts of an input": (two_inputs, (1, 2, 4), r"inputs of lengths \(3, 4\), got lengths \(1, 2, 4\)\."),
    "one input of two": (two_inputs, (3,), r"inputs of lengths \(3, 4\), got lengths \(3,\)\."),
    "another length": (one_input, (2,), r"the network takes an input of length 3, got lengths \(2,\)\."),
    "none": (one_input, (), r"an input of length 3, got lengths \(\)\."),
}


@pytest.mark.parametrize("case", WRONG_INPUTS)
def test_a_network_refuses_inputs_of_other_lengths(case):
    network, lengths, said = WRONG_INPUTS[case]
    with pytest.raises(ProblemError, match=said):
        network()(*(ca.MX.sym("x", length) for length in lengths))


@pytest.mark.parametrize("network", [one_input, two_inputs])
def test_a_network_refuses_what_is_no_column_of_casadi(network):
    with pytest.raises(
        ProblemError, match=r"a network takes columns of CasADi, got ndarray; casadi\.DM\(x\) makes one\."
    ):
        network()(np.zeros(3))


def test_parts_of_an_input_stand_below_one_another():
    s, u = ca.MX.sym("s", 2), ca.MX.sym("u")
    for network in (one_input(), GraphNetwork(ca.Function("f", [x := ca.MX.sym("x", 3)], [x[:2]]))):
        np.testing.assert_array_equal(ca.Function("f", [s, u], [network(s, u)])([1, 2], 3), [[1], [2]])


@pytest.mark.filterwarnings("ignore")
def test_plans_through_a_residual_network_have_certified_gradients(tmp_path):
    module = build("x + net(x, u)")
    network = load_onnx(export(module, tmp_path / "dynamics.onnx", dynamo=False))
    s, u, psi = ca.MX.sym("s", 4), ca.MX.sym("u", 1), ca.MX.sym("psi", 2)
    problem = OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        horizon=8,
        dynamics=network(s, u),
        stage_cost=psi[0] * ca.sumsqr(s - 1) + psi[1] * u**2,
        action_bounds=(-1, 1),
    )
    demonstrated = Riccati().solve(problem, np.zeros(4), [1, 0.5]).raise_if_failed()
    exact = copy.deepcopy(module).double()
    state = torch.zeros(1, 4, dtype=torch.float64)
    for action, following in zip(demonstrated.actions, demonstrated.states[1:], strict=True):
        state = exact(state, torch.tensor(action)[None])
        np.testing.assert_allclose(state.detach().numpy()[0], following, rtol=0, atol=1e-6)
    loss, gradient, certificate = Implicit()(problem, Demonstration(np.zeros(4), [], demonstrated.states), [1.0, 0.1])
    assert certificate.certified
    assert loss > 1e-4
    h = 1e-5
    losses = [
        Implicit()(problem, Demonstration(np.zeros(4), [], demonstrated.states), [1.0, 0.1 + d])[0] for d in (h, -h)
    ]
    np.testing.assert_allclose(gradient[1], (losses[0] - losses[1]) / (2 * h), rtol=1e-6)


def test_keypoint_dynamics_of_another_graph_are_refused_with_the_way_out():
    x = ca.MX.sym("x", 11)
    network = GraphNetwork(ca.Function("f", [x], [x[:2] ** 2]))
    with pytest.raises(ProblemError, match=r"need an MLP.*OCP\.from_expressions"):
        NetworkDynamics(network, n_z=2, n_joints=3)
