"""Learned dynamics on disk: the numbers of torch, and every defect named with file and key."""

import json
import sys
from itertools import pairwise

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from kpirl_ocp.errors import DependencyError, ModelError
from kpirl_ocp.ocp.models.dynamics_files import load_dynamics
from kpirl_ocp.ocp.models.onnx.load import load_onnx

WIDTHS = (8 + 3 * 3, 20, 10, 8)


def card(**changes):
    return {
        "kind": "kpirl_ocp.dynamics",
        "version": 1,
        "inputs": {"keypoints": 8, "joints": 3, "velocities": 3, "actions": 3},
        "hidden": [20, 10],
        "activation": "relu",
        "residual": True,
        "rate": 5.0,
        "training": {"epochs": 3},
        "metrics": {"nmse": 0.01},
    } | changes


def tensors():
    rng, found = np.random.default_rng(0), {}
    for i, (n_in, n_out) in enumerate(pairwise(WIDTHS)):
        found[f"layers.{i}.weight"] = rng.normal(size=(n_out, n_in)) / np.sqrt(n_in)
        found[f"layers.{i}.bias"] = rng.normal(size=n_out)
    for name, n in (("input", WIDTHS[0]), ("output", WIDTHS[-1])):
        found[f"{name}.mean"] = rng.normal(size=n)
        found[f"{name}.scale"] = rng.uniform(0.2, 3, n)
    return {key: value.astype(np.float32) for key, value in found.items()}


@pytest.fixture
def path(tmp_path):
    write(tmp_path / "arm.json", card(), tensors())
    return tmp_path / "arm.json"


def write(path, text, arrays):
    path.write_text(json.dumps(text))
    save_file(arrays, path.with_suffix(".safetensors"))


@pytest.mark.parametrize("residual", [True, False])
@pytest.mark.parametrize("activation", ["relu", "softplus", "tanh", "silu"])
def test_loaded_dynamics_are_those_of_torch(path, activation, residual):
    torch = pytest.importorskip("torch")
    write(path, card(activation=activation, residual=residual), tensors())
    w = {
        key: torch.tensor(value, dtype=torch.float64)
        for key, value in load_file(path.with_suffix(".safetensors")).items()
    }
    rng = np.random.default_rng(1)
    z, theta, velocity, u = (rng.normal(size=n) for n in (8, 3, 3, 3))
    h = (torch.tensor(np.concatenate([z, theta, velocity, u])) - w["input.mean"]) / w["input.scale"]
    for i in range(3):
        h = w[f"layers.{i}.weight"] @ h + w[f"layers.{i}.bias"]
        h = getattr(torch.nn.functional, activation)(h) if i < 2 else h
    expected = residual * z + (w["output.mean"] + w["output.scale"] * h).numpy()
    dynamics = load_dynamics(path)
    found = np.array(dynamics.function(0)(dynamics.state(z, theta, velocity), u, [])).ravel()
    np.testing.assert_allclose(found, np.concatenate([expected, theta + u, velocity]), rtol=0, atol=1e-13)
    assert (dynamics.rate, dynamics.n_z, dynamics.n_joints) == (5.0, 8, 3)


def test_a_network_without_hidden_layers_is_a_linear_model(path):
    arrays = tensors()
    linear = {key: value for key, value in arrays.items() if not key.startswith("layers")}
    linear |= {"layers.0.weight": np.ones((8, 17), np.float32), "layers.0.bias": np.zeros(8, np.float32)}
    write(path, card(hidden=[]), linear)
    assert load_dynamics(str(path)).mlp.activations == ("identity",)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"kind": "kpirl_ocp.detector"}, "'kind' must be 'kpirl_ocp.dynamics'; it is 'kpirl_ocp.detector'"),
        ({"version": 2}, "'version' must be 1; it is 2"),
        ({"activation": "gelu"}, "'activation' must be one of elu, .*; it is 'gelu'"),
        ({"activation": None}, "'activation' must be one of"),
        ({"hidden": [100, 0]}, "'hidden' must be a list of layer widths"),
        ({"hidden": 100}, "'hidden' must be a list of layer widths; it is 100"),
        (
            {"inputs": {"keypoints": 8, "joints": 3}},
            "'inputs' must be counts of keypoints, joints, velocities, actions",
        ),
        ({"inputs": [8, 3, 3, 3]}, "'inputs' must be counts"),
        ({"inputs": card()["inputs"] | {"actions": 2}}, "'inputs' must be .*, the last three equal"),
        ({"residual": 1}, "'residual' must be true or false; it is 1"),
        ({"rate": 0}, "'rate' must be a positive number"),
    ],
)
def test_a_wrong_card_is_refused_by_file_and_key(path, changes, reason):
    write(path, card(**changes), tensors())
    with pytest.raises(ModelError, match=rf"arm\.json: {reason}"):
        load_dynamics(path)


@pytest.mark.parametrize("key", ["kind", "version", "inputs", "hidden", "activation", "residual", "rate"])
def test_a_missing_entry_of_the_card_is_named(path, key):
    write(path, {name: value for name, value in card().items() if name != key}, tensors())
    with pytest.raises(ModelError, match=rf"arm\.json: '{key}' must be .*; it is 'missing'"):
        load_dynamics(path)


@pytest.mark.parametrize("key", tensors())
def test_a_missing_tensor_is_named(path, key):
    write(path, card(), {name: value for name, value in tensors().items() if name != key})
    with pytest.raises(ModelError, match=rf"arm\.safetensors: '{key}' is missing"):
        load_dynamics(path)


@pytest.mark.parametrize(
    ("key", "value", "reason"),
    [
        ("layers.1.weight", np.ones((10, 21), np.float32), r"must be floats \(10, 20\); it is float32 \(10, 21\)"),
        ("layers.0.bias", np.ones(20, np.int64), r"must be floats \(20,\); it is int64 \(20,\)"),
        ("layers.2.bias", np.full(8, np.nan, np.float32), "holds NaN or infinity"),
        ("input.mean", np.full(17, np.inf, np.float32), "holds NaN or infinity"),
        ("output.scale", np.zeros(8, np.float32), "must be positive"),
    ],
)
def test_a_wrong_tensor_is_refused_by_file_and_key(path, key, value, reason):
    write(path, card(), tensors() | {key: value})
    with pytest.raises(ModelError, match=rf"arm\.safetensors: '{key}' {reason}"):
        load_dynamics(path)


def test_tensors_that_the_card_does_not_mention_are_refused(path):
    write(path, card(), tensors() | {"layers.3.weight": np.ones((8, 8), np.float32)})
    with pytest.raises(ModelError, match=r"does not account for layers\.3\.weight"):
        load_dynamics(path)


def test_files_that_are_missing_or_garbled_are_named(path):
    with pytest.raises(ModelError, match=r"no model card .*other\.json: train"):
        load_dynamics(path.with_name("other.json"))
    path.with_suffix(".safetensors").write_bytes(b"nonsense")
    with pytest.raises(ModelError, match=r"arm\.safetensors cannot be read as safetensors"):
        load_dynamics(path)
    path.with_suffix(".safetensors").unlink()
    with pytest.raises(ModelError, match=r"no weight file .*arm\.safetensors"):
        load_dynamics(path)
    path.write_text("{")
    with pytest.raises(ModelError, match=r"arm\.json cannot be read as JSON"):
        load_dynamics(path)
    path.write_text("[]")
    with pytest.raises(ModelError, match="must hold one JSON object"):
        load_dynamics(path)


def test_without_the_onnx_package_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(DependencyError, match="pip install onnx"):
        load_onnx("network.onnx")
