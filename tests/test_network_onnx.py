"""Networks from ONNX files: the numbers of the graph, and a refusal by name of every operator that nobody knows."""

import casadi as ca
import numpy as np
import pytest

from kpirl_ocp.errors import ModelError
from kpirl_ocp.ocp.models.graph_network import GraphNetwork
from kpirl_ocp.ocp.models.mlp import MLP
from kpirl_ocp.ocp.models.onnx import casadi_reader
from kpirl_ocp.ocp.models.onnx.load import load_onnx

onnx = pytest.importorskip("onnx")
reference = pytest.importorskip("onnx.reference")

RNG = np.random.default_rng(0)
ARRAYS = {
    "W0": RNG.normal(size=(5, 3)),
    "b0": RNG.normal(size=5),
    "W1": RNG.normal(size=(2, 5)),
    "b1": RNG.normal(size=(1, 2)),
    "V0": RNG.normal(size=(3, 5)),
    "W2": RNG.normal(size=(2, 2)),
    "mean": RNG.normal(size=3),
    "width": RNG.uniform(0.5, 2, size=(1, 3)),
    "gain": np.array(3.0),
}
FIRST = [("Gemm", ["x", "W0", "b0"], "a", {"transB": 1})]
LAST = [("Gemm", ["h", "W1", "b1"], "y", {"transB": 1})]
TANH = ("Tanh", ["g"], "y")
CHAINS = {
    "Relu": [*FIRST, ("Relu", ["a"], "h"), *LAST],
    "Tanh": [*FIRST, ("Tanh", ["a"], "h"), *LAST],
    "Sigmoid": [*FIRST, ("Sigmoid", ["a"], "h"), *LAST],
    "Softplus": [*FIRST, ("Softplus", ["a"], "h"), *LAST],
    "Elu": [*FIRST, ("Elu", ["a"], "h", {"alpha": 1.0}), *LAST],
    "LeakyRelu": [*FIRST, ("LeakyRelu", ["a"], "h"), *LAST],
    "Identity": [*FIRST, ("Identity", ["a"], "h"), *LAST],
    "silu": [*FIRST, ("Sigmoid", ["a"], "s"), ("Mul", ["s", "a"], "h"), *LAST],
    "MatMul and Add": [("MatMul", ["x", "V0"], "m"), ("Add", ["b0", "m"], "a"), ("Relu", ["a"], "h"), *LAST],
    "scaled Gemm": [("Gemm", ["x", "V0", "b0"], "h", {"alpha": 2.0, "beta": 0.5}), *LAST],
    "output activation": [*FIRST, ("Relu", ["a"], "h"), ("Gemm", ["h", "W1"], "g", {"transB": 1}), TANH],
}


def write(path, chain, outputs=("y",)):
    helper = onnx.helper
    nodes = [helper.make_node(kind, i, o.split(), **(rest[0] if rest else {})) for kind, i, o, *rest in chain]
    used = {name for node in nodes for name in node.input}
    graph = helper.make_graph(
        nodes,
        "network",
        [helper.make_tensor_value_info("x", onnx.TensorProto.DOUBLE, [1, 3])],
        [helper.make_tensor_value_info(name, onnx.TensorProto.DOUBLE, [1, 2]) for name in outputs],
        [onnx.numpy_helper.from_array(array, name) for name, array in ARRAYS.items() if name in used],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)]), path)
    return path


@pytest.mark.parametrize("name", CHAINS)
def test_network_is_that_of_the_onnx_reference(tmp_path, name):
    path = write(tmp_path / "network.onnx", CHAINS[name])
    mlp, x = load_onnx(path), ca.MX.sym("x", 3)
    evaluate = ca.Function("network", [x], [mlp(x)])
    (expected,) = reference.ReferenceEvaluator(str(path)).run(None, {"x": np.array([[0.3, -1.2, 0.7]])})
    tolerance = 1e-7 if name == "LeakyRelu" else 1e-14  # its slope 0.01 is a float32 in the file
    np.testing.assert_allclose(np.array(evaluate([0.3, -1.2, 0.7])).T, expected, rtol=0, atol=tolerance)


def test_the_graph_of_a_torch_network_has_its_weights_and_activations(tmp_path):
    mlp = load_onnx(write(tmp_path / "network.onnx", CHAINS["silu"]))
    assert mlp.activations == ("silu", "identity")
    np.testing.assert_array_equal(mlp.weights[0], ARRAYS["W0"])
    np.testing.assert_array_equal(mlp.biases[1], ARRAYS["b1"].ravel())


GRAPHS = {
    "Gelu": [*FIRST, ("Gelu", ["a"], "h"), *LAST],
    "Mul": [*FIRST, ("Mul", ["a", "a"], "h"), *LAST],
    "Elu with alpha": [*FIRST, ("Elu", ["a"], "h", {"alpha": 0.5}), *LAST],
    "a value that is used twice": [*FIRST, ("Tanh", ["a"], "t"), ("Add", ["a", "t"], "h"), *LAST],
    "division by a value": [*FIRST, ("Div", ["b0", "a"], "h"), *LAST],
}


@pytest.mark.parametrize("name", GRAPHS)
def test_other_graphs_have_the_numbers_of_the_onnx_reference(tmp_path, name):
    path = write(tmp_path / "network.onnx", GRAPHS[name])
    network, x = load_onnx(path), np.array([[0.3, -1.2, 0.7]])
    assert isinstance(network, GraphNetwork)
    (expected,) = reference.ReferenceEvaluator(str(path)).run(None, {"x": x})
    tolerance = 1e-7 if name == "Gelu" else 1e-14  # the reference has its own, rougher erf
    np.testing.assert_allclose(np.array(network.function(x.T)).T, expected, rtol=0, atol=tolerance)


ACTIVATIONS_ALONE = {
    "two activations": [*FIRST, ("Relu", ["a"], "r"), ("Tanh", ["r"], "h"), *LAST],
    "an activation first": [("Relu", ["x"], "r"), ("Gemm", ["r", "W0", "b0"], "h", {"transB": 1}), *LAST],
    "a normalisation first": [("Sub", ["x", "mean"], "d"), ("Div", ["d", "width"], "n"), ("Tanh", ["n"], "r"),
                              ("Gemm", ["r", "W0", "b0"], "h", {"transB": 1}), *LAST],
    "a negative Sub": [*FIRST, ("Sub", ["b0", "a"], "d"), ("Relu", ["d"], "h"), *LAST],
    "a scale at the end": [*FIRST, ("Relu", ["a"], "h"), ("Gemm", ["h", "W1"], "g", {"transB": 1}),
                           ("Tanh", ["g"], "t"), ("Mul", ["t", "gain"], "y")],
}  # fmt: skip


@pytest.mark.parametrize("name", ACTIVATIONS_ALONE)
def test_what_stands_between_layers_becomes_part_of_a_layer(tmp_path, name):
    path = write(tmp_path / "network.onnx", ACTIVATIONS_ALONE[name])
    mlp, x = load_onnx(path), ca.MX.sym("x", 3)
    assert isinstance(mlp, MLP)
    (expected,) = reference.ReferenceEvaluator(str(path)).run(None, {"x": np.array([[0.3, -1.2, 0.7]])})
    found = ca.Function("network", [x], [mlp(x)])([0.3, -1.2, 0.7])
    np.testing.assert_allclose(np.array(found).T, expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("chain", "reason"),
    [
        ([*FIRST, ("Round", ["a"], "h"), *LAST], "Unsupported operation 'Round'"),
        ([("Gemm", ["x", "V0"], "y", {"transA": 1})], "the graph is not valid"),
        ([*FIRST, ("Gemm", ["a", "W2"], "y", {"transB": 1})], "the graph is not valid: .*between 2 and 5"),
        ([*FIRST, ("Relu", ["a"], "h")], "the graph is not valid"),
        ([*FIRST, ("Softmax", ["a"], "h", {"axis": 0}), *LAST], "Softmax along axis 0 is not supported"),
        ([*FIRST, ("BatchNormalization", ["a", "b0", "b0", "b0", "b0"], "h m v", {"training_mode": 1}), *LAST],
         "training mode"),
    ],
)  # fmt: skip
def test_a_graph_that_nobody_knows_is_refused(tmp_path, chain, reason):
    path = write(tmp_path / "odd.onnx", chain)
    with pytest.raises(ModelError, match=rf"odd\.onnx: .*{reason}"):
        load_onnx(path)


def test_a_graph_with_two_outputs_is_refused(tmp_path):
    path = write(tmp_path / "odd.onnx", [*FIRST, ("Relu", ["a"], "h"), *LAST], outputs=("y", "y"))
    with pytest.raises(ModelError, match=r"odd\.onnx: "):
        load_onnx(path)


def test_a_graph_that_is_read_with_other_numbers_is_refused(tmp_path, monkeypatch):
    path = write(tmp_path / "odd.onnx", GRAPHS["Mul"])
    wrong = ca.Function("wrong", [ca.MX.sym("x", 1, 3)], [ca.MX.zeros(1, 2)])
    monkeypatch.setattr(casadi_reader, "_read", lambda model: wrong)
    with pytest.raises(ModelError, match="other numbers than ONNX's reference"):
        load_onnx(path)


def test_a_file_that_is_not_onnx_is_refused(tmp_path):
    (tmp_path / "network.onnx").write_text("nonsense")
    with pytest.raises(ModelError, match=r"network\.onnx cannot be read as ONNX"):
        load_onnx(tmp_path / "network.onnx")
    with pytest.raises(ModelError, match=r"missing\.onnx cannot be read"):
        load_onnx(tmp_path / "missing.onnx")
