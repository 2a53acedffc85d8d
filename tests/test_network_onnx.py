"""Networks from ONNX files: the numbers of the graph, and a refusal by name of every operator that is no layer."""

import casadi as ca
import numpy as np
import pytest

from kpirl_ocp.errors import ModelError
from kpirl_ocp.ocp.models.onnx_files import load_onnx

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
    nodes = [helper.make_node(kind, i, [o], **(rest[0] if rest else {})) for kind, i, o, *rest in chain]
    used = {name for node in nodes for name in node.input}
    graph = helper.make_graph(
        nodes,
        "network",
        [helper.make_tensor_value_info("x", onnx.TensorProto.DOUBLE, [1, 3])],
        [helper.make_tensor_value_info(name, onnx.TensorProto.DOUBLE, [1, 2]) for name in outputs],
        [onnx.numpy_helper.from_array(array, name) for name, array in ARRAYS.items() if name in used],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)]), path)
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


@pytest.mark.parametrize(
    ("chain", "reason"),
    [
        ([*FIRST, ("Gelu", ["a"], "h"), *LAST], "operator Gelu is not supported; supported are Gemm, MatMul"),
        ([*FIRST, ("Mul", ["a", "a"], "h"), *LAST], "operator Mul is not supported"),
        ([*FIRST, ("Elu", ["a"], "h", {"alpha": 0.5}), *LAST], "operator Elu has alpha = 0.5; only 1 is supported"),
        ([*FIRST, ("Relu", ["a"], "r"), ("Tanh", ["r"], "h"), *LAST], "operator Tanh stands where no layer"),
        ([("Relu", ["x"], "h"), *LAST], "operator Relu stands where no layer"),
        ([*FIRST, ("Gemm", ["a", "W1"], "g", {"transB": 1}), ("Relu", ["a"], "y")], "single chain"),
        ([("Gemm", ["x", "V0"], "y", {"transA": 1})], "Gemm with transA"),
        ([*FIRST, ("Relu", ["a"], "h")], r"one input and one output; the graph has \['x'\] and \['y'\]"),
        ([*FIRST, ("Gemm", ["a", "W2"], "y", {"transB": 1})], r"layer 1 must have a weight \(n, 5\)"),
    ],
)
def test_a_graph_that_is_no_plain_network_is_refused(tmp_path, chain, reason):
    path = write(tmp_path / "odd.onnx", chain)
    with pytest.raises(ModelError, match=rf"odd\.onnx: .*{reason}"):
        load_onnx(path)


def test_a_file_that_is_not_onnx_is_refused(tmp_path):
    (tmp_path / "network.onnx").write_text("nonsense")
    with pytest.raises(ModelError, match=r"network\.onnx cannot be read as ONNX"):
        load_onnx(tmp_path / "network.onnx")
    with pytest.raises(ModelError, match=r"missing\.onnx cannot be read"):
        load_onnx(tmp_path / "missing.onnx")
