"""The learned dynamics of keypoints: the equation, training on systems that are known, files."""

import json
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("torch")
import torch
from safetensors.numpy import load_file, save_file

from kpirl_ocp.episodes import ArmTrack
from kpirl_ocp.errors import FileError, ModelError, TrainingError
from kpirl_ocp.perception.dynamics import training
from kpirl_ocp.perception.dynamics.augmentation import augmented, backwards
from kpirl_ocp.perception.dynamics.model import ACTIVATIONS, DynamicsModel
from kpirl_ocp.perception.dynamics.training import DynamicsSettings, Stretches, score_dynamics, train_dynamics

torch.set_num_threads(1)

JOINTS, COORDINATES = 3, 4
GAIN = np.random.default_rng(0).normal(0.0, 1.0, (COORDINATES, JOINTS))


def track(z, joints, actions):
    """A track of keypoints z (T+1, 2 K) with mu = 1, at rest."""
    keypoints = np.concatenate([z.reshape(len(z), -1, 2), np.ones((len(z), z.shape[1] // 2, 1))], -1)
    return ArmTrack(keypoints, np.arange(len(z)) / 5, joints, np.zeros_like(joints), actions)


def linear(seed, steps=15):
    """z_{t+1} = z_t + B u_t with random actions."""
    rng = np.random.default_rng(seed)
    actions = rng.normal(0.0, 0.05, (steps, JOINTS))
    moved = np.vstack([np.zeros(JOINTS), actions.cumsum(axis=0)])
    return track(rng.uniform(-0.5, 0.5, COORDINATES) + moved @ GAIN.T, rng.uniform(-1, 1, JOINTS) + moved, actions)


TRAIN, TEST = [linear(seed) for seed in range(60)], [linear(seed) for seed in range(1000, 1020)]
QUICK = DynamicsSettings(epochs=3, batch=64)


@pytest.fixture(scope="module")
def trained():
    """A model of the linear system and its training curves."""
    return train_dynamics(TRAIN, DynamicsSettings(activation="tanh", epochs=100, batch=64))


def random_model(activation="relu"):
    torch.manual_seed(0)
    model = DynamicsModel(COORDINATES, JOINTS, activation)
    rng = np.random.default_rng(1)
    model.normalise(*(torch.from_numpy(rng.normal(1.0, 2.0, (50, n))).float() for n in (13, COORDINATES)))
    return model.eval()


def inputs(count=5):
    generator = torch.Generator().manual_seed(2)
    return [torch.randn(count, n, generator=generator) for n in (COORDINATES, JOINTS, JOINTS, JOINTS)]


# The equation

FUNCTIONS = {
    "relu": lambda x: np.maximum(x, 0),
    "tanh": np.tanh,
    "softplus": lambda x: np.log1p(np.exp(x)),
    "silu": lambda x: x / (1 + np.exp(-x)),
}


def test_there_is_a_closed_form_of_every_activation():
    assert set(FUNCTIONS) == set(ACTIVATIONS)


@pytest.mark.parametrize("activation", FUNCTIONS)
def test_the_model_is_the_equation(activation):
    model, state = random_model(activation), inputs()
    values = {name: tensor.double().numpy() for name, tensor in model.state_dict().items()}
    x = (np.hstack(state) - values["input_mean"]) / values["input_scale"]
    for layer in (0, 1):
        x = FUNCTIONS[activation](x @ values[f"layers.{layer}.weight"].T + values[f"layers.{layer}.bias"])
    out = x @ values["layers.2.weight"].T + values["layers.2.bias"]
    with torch.no_grad():
        found = model(*state)
    np.testing.assert_allclose(
        found, state[0].numpy() + values["output_mean"] + values["output_scale"] * out, rtol=0, atol=1e-5
    )


def test_the_layers_are_those_of_the_paper():
    shapes = [tuple(layer.weight.shape) for layer in DynamicsModel(8, 7).layers]
    assert shapes == [(100, 8 + 3 * 7), (25, 100), (8, 25)]


def test_normalised_training_data_have_mean_zero_and_deviation_one_and_a_constant_is_left_unscaled():
    data = np.random.default_rng(3).normal(5.0, 3.0, (200, 13))
    data[:, 6] = 2.0
    changes = data[:, :COORDINATES] / 10
    model = DynamicsModel(COORDINATES, JOINTS)
    model.normalise(torch.from_numpy(data).float(), torch.from_numpy(changes).float())
    kept = {name: value.numpy() for name, value in model.named_buffers()}
    normal = (data - kept["input_mean"]) / kept["input_scale"]
    moving = np.arange(13) != 6
    np.testing.assert_allclose(normal.mean(axis=0), 0.0, atol=1e-5)
    np.testing.assert_allclose(normal.std(axis=0, ddof=1)[moving], 1.0, rtol=1e-5)
    assert kept["input_scale"][6] == 1.0
    np.testing.assert_allclose(kept["output_mean"], changes.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(kept["output_scale"], changes.std(axis=0, ddof=1), rtol=1e-5)


def test_velocities_that_are_rounding_are_scaled_as_if_they_were_a_hundredth_of_a_radian_per_second():
    data = np.random.default_rng(3).normal(0.0, 1.0, (200, 13))
    resting, still = COORDINATES + JOINTS, COORDINATES + JOINTS + 1
    data[:, resting], data[:, still] = 1e-4 * data[:, resting], 0.0
    model = DynamicsModel(COORDINATES, JOINTS)
    model.normalise(torch.from_numpy(data).float(), torch.from_numpy(data[:, :COORDINATES]).float())
    scale = model.get_buffer("input_scale").numpy()
    np.testing.assert_allclose(scale[[resting, still]], [1e-2, 1.0], rtol=1e-6)
    assert scale[still + 1] > 0.5


def test_a_rollout_feeds_predictions_back_and_integrates_the_joints():
    model = random_model()
    z, theta, velocity, _ = inputs()
    actions = torch.randn(5, 6, JOINTS, generator=torch.Generator().manual_seed(4))
    with torch.no_grad():
        found = model.rollout(z, theta, velocity, actions)
        for h in range(6):
            z = model(z, theta + actions[:, :h].sum(1), velocity, actions[:, h])
            torch.testing.assert_close(found[:, h], z, rtol=0, atol=1e-5)


# Stretches of trajectories


def test_stretches_are_all_windows_of_all_trajectories():
    short, long = linear(0, steps=2), linear(1, steps=5)
    found = Stretches.of([short, long], 3)
    assert len(found) == 3  # none of the short one
    for t in range(3):
        z = long.keypoints[t : t + 4, :, :2].reshape(4, COORDINATES)
        for value, expected in (
            (found.z[t], z),
            (found.theta[t], long.joints[t]),
            (found.velocity[t], long.velocities[t]),
            (found.actions[t], long.actions[t : t + 3]),
        ):
            np.testing.assert_allclose(value, expected, rtol=1e-6)


def test_trajectories_that_are_too_short_are_refused():
    with pytest.raises(TrainingError, match="no trajectory has 20 steps"):
        Stretches.of(TEST, 20)


# Training


def test_a_linear_system_is_learned_to_a_tiny_error(trained):
    found = score_dynamics(trained[0], TEST, steps=5)
    assert found.model.shape == found.persistence.shape == (5, COORDINATES)
    assert found.model[0].max() < 5e-4
    assert (found.model < 0.02 * found.persistence).all(), found.model / found.persistence


def test_the_model_is_that_of_the_best_epoch():
    """Its score on the held-out tenth is the lowest of the curve."""
    settings = replace(QUICK, epochs=25, step_size=0.05)  # too large on purpose: the last epoch is not the best
    model, curves = train_dynamics(TRAIN, settings)
    assert set(curves) == {"train", "validation"}
    order = np.random.default_rng(0).permutation(len(TRAIN))
    held, rest = ([TRAIN[i] for i in chosen] for chosen in (order[:6], order[6:]))
    variance = Stretches.of(rest, 1).z[:, 1].var(0)
    data = Stretches.of(held, 1)
    with torch.no_grad():
        error = ((data.predict(model) - data.z[:, 1:]).square().mean((0, 1)) / variance).mean()
    np.testing.assert_allclose(error, curves["validation"].min(), rtol=1e-5)
    assert curves["validation"].argmin() < len(curves["validation"]) - 1


def test_training_waits_for_as_many_epochs_as_it_is_told():
    _, curves = train_dynamics(TRAIN, replace(QUICK, epochs=200, step_size=0.05, patience=4))
    validation = curves["validation"]
    assert len(validation) < 200
    assert len(validation) - 1 - validation.argmin() == 4


def test_a_seed_repeats_and_another_differs():
    one, two, other = (train_dynamics(TRAIN, QUICK, seed)[0].state_dict() for seed in (1, 1, 2))
    assert all(torch.equal(one[name], two[name]) for name in one)
    assert not torch.equal(one["layers.0.weight"], other["layers.0.weight"])


def test_the_loss_can_be_taken_over_several_steps(trained):
    model, curves = train_dynamics(TRAIN, replace(QUICK, steps=4, epochs=40, activation="tanh"))
    assert curves["train"][-1] < 0.05 * curves["train"][0]
    found = score_dynamics(model, TEST, steps=4)
    assert (found.model.mean(axis=1) < 0.1 * found.persistence.mean(axis=1)).all()


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_every_activation_can_be_trained(activation):
    _, curves = train_dynamics(TRAIN, replace(QUICK, activation=activation))
    assert curves["validation"][-1] < curves["validation"][0]


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_trajectories_are_refused(count):
    with pytest.raises(TrainingError, match=f"at least two trajectories, got {count}"):
        train_dynamics(TRAIN[:count], QUICK)


def test_a_loss_that_is_no_number_stops_the_training():
    with pytest.raises(TrainingError, match="smaller step size"):
        train_dynamics(TRAIN, replace(QUICK, step_size=1e30))


def test_a_model_that_predicts_nan_is_never_given_back():
    with pytest.raises(TrainingError, match="smaller step size"):
        train_dynamics(TRAIN, replace(QUICK, epochs=1, batch=100_000, step_size=1e30))


@pytest.mark.parametrize("wrong", [{"steps": 0}, {"epochs": 0}])
def test_training_of_nothing_is_refused(wrong):
    with pytest.raises(TrainingError, match="must be at least 1"):
        train_dynamics(TRAIN, replace(QUICK, **wrong))


def test_a_coordinate_that_never_moves_is_named_or_left_out():
    stuck = [track(np.column_stack([np.full(16, 0.3), np.zeros((16, 1))]), t.joints, t.actions) for t in TRAIN[:4]]
    said = ""
    try:
        _, curves = train_dynamics(stuck, QUICK)
        assert np.isfinite(curves["validation"]).all()
    except TrainingError as error:
        said = str(error)
    assert "step size" not in said


# Scores


def steady(velocity, steps=20):
    """Every coordinate moves with its own constant velocity (n_z,) per step."""
    z = 0.1 + np.outer(np.arange(steps + 1), velocity)
    return track(z, np.zeros((steps + 1, JOINTS)), np.zeros((steps, JOINTS)))


def test_persistence_of_a_steady_motion_is_its_closed_form():
    velocity, ahead = np.array([0.01, -0.02, 0.03, 0.005]), 5
    found = score_dynamics(random_model(), [steady(velocity)], ahead)
    steps = np.arange(1, ahead + 1)
    times = np.concatenate([start + steps for start in range(20 - ahead + 1)])
    expected = np.outer(steps**2, velocity**2) / (velocity**2 * times.var(ddof=1))  # h^2 v^2 / var z
    np.testing.assert_allclose(found.persistence, expected, rtol=1e-4)


def still_model(drift):
    """A network that says nothing, with the mean change as all it knows."""
    model = DynamicsModel(COORDINATES, JOINTS)
    torch.nn.init.zeros_(model.layers[-1].weight)
    torch.nn.init.zeros_(model.layers[-1].bias)
    model.output_mean.copy_(torch.as_tensor(drift))
    return model


def test_a_model_without_change_is_persistence_and_one_with_the_right_drift_is_exact():
    velocity = np.array([0.01, -0.02, 0.03, 0.005])
    found = score_dynamics(still_model(np.zeros(4)), [steady(velocity)], 5)
    np.testing.assert_array_equal(found.model, found.persistence)
    exact = score_dynamics(still_model(velocity), [steady(velocity)], 5)
    np.testing.assert_allclose(exact.model, 0.0, atol=1e-10)


# Files

CARD = {"rate": 5.0, "training": {"seed": 0}}


@pytest.fixture
def saved(tmp_path):
    return random_model("silu").save(tmp_path / "models" / "dynamics.json", CARD)


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_a_model_survives_the_disk_bit_by_bit(tmp_path, activation):
    model = random_model(activation)
    again = DynamicsModel.load(model.save(tmp_path / "dynamics.json", CARD))
    with torch.no_grad():
        assert torch.equal(again(*inputs()), model(*inputs()))
    for name, value in model.state_dict().items():
        assert torch.equal(again.state_dict()[name], value)


def test_the_card_says_what_the_weights_mean(saved):
    card, tensors = json.loads(saved.read_text()), load_file(saved.with_suffix(".safetensors"))
    assert (card["kind"], card["version"]) == ("kpirl_ocp.dynamics", 1)
    assert card["inputs"] == {"keypoints": 4, "joints": 3, "velocities": 3, "actions": 3}
    assert (card["hidden"], card["activation"], card["residual"]) == ([100, 25], "silu", True)
    assert (card["rate"], card["training"]) == (5.0, {"seed": 0})
    assert set(tensors) == {
        *(f"{side}.{what}" for side in ("input", "output") for what in ("mean", "scale")),
        *(f"layers.{layer}.{what}" for layer in range(3) for what in ("weight", "bias")),
    }
    assert {value.dtype for value in tensors.values()} == {np.dtype(np.float32)}


def test_a_missing_or_damaged_model_is_named(saved):
    weights = saved.with_suffix(".safetensors")
    whole = weights.read_bytes()
    for content in (b"", whole[:50], whole[:-1]):
        weights.write_bytes(content)
        with pytest.raises(ModelError, match=r"dynamics\.safetensors cannot be read as safetensors"):
            DynamicsModel.load(saved)
    weights.unlink()
    with pytest.raises(ModelError, match=r"no weight file .*dynamics\.safetensors"):
        DynamicsModel.load(saved)


def test_a_detector_is_no_dynamics(saved):
    saved.write_text(json.dumps(json.loads(saved.read_text()) | {"kind": "kpirl_ocp.detector"}))
    with pytest.raises(
        ModelError, match=r"dynamics\.json: 'kind' must be 'kpirl_ocp\.dynamics'; it is 'kpirl_ocp\.detector'"
    ):
        DynamicsModel.load(saved)


def test_weights_that_are_not_finite_are_named(saved):
    weights = saved.with_suffix(".safetensors")
    save_file(load_file(weights) | {"input.scale": np.full(13, np.inf, np.float32)}, weights)
    with pytest.raises(ModelError, match=r"dynamics\.safetensors: 'input\.scale' holds NaN"):
        DynamicsModel.load(saved)


@pytest.mark.parametrize(
    "change", [{"inputs": {}}, {"hidden": [50, 25]}, {"activation": "gelu"}], ids=["inputs", "hidden", "activation"]
)
def test_a_card_that_does_not_fit_its_weights_is_named(saved, change):
    saved.write_text(json.dumps(json.loads(saved.read_text()) | change))
    with pytest.raises(ModelError, match="dynamics"):
        DynamicsModel.load(saved)


def test_a_motion_played_backwards_obeys_the_same_dynamics():
    for there, back in zip(TRAIN[:5], map(backwards, TRAIN[:5]), strict=True):
        z = back.keypoints[..., :2].reshape(len(back.times), -1)
        np.testing.assert_allclose(np.diff(z, axis=0), back.actions @ GAIN.T, rtol=0, atol=1e-12)
        np.testing.assert_allclose(back.joints[:-1] + back.actions, back.joints[1:], rtol=0, atol=1e-12)
        again = backwards(back)
        np.testing.assert_array_equal(again.keypoints, there.keypoints)
        np.testing.assert_allclose(again.actions, there.actions, rtol=0, atol=1e-12)


def test_a_motion_played_backwards_has_the_velocities_of_one():
    slow = replace(TRAIN[0], velocities=np.linspace(-0.01, 0.01, TRAIN[0].velocities.size).reshape(-1, JOINTS) ** 3)
    np.testing.assert_array_equal(backwards(slow).velocities[0], -slow.velocities[-1])
    np.testing.assert_array_equal(backwards(backwards(slow)).velocities, slow.velocities)


def test_augmented_data_are_forwards_and_backwards_without_and_with_noise():
    found = augmented(TRAIN[:20], np.random.default_rng(0))
    assert len(found) == 80
    for clean, noisy in zip(found[:40], found[40:], strict=True):
        np.testing.assert_array_equal(noisy.joints, clean.joints)
        np.testing.assert_array_equal(noisy.keypoints[..., 2], clean.keypoints[..., 2])
    pairs = zip(found[:40], found[40:], strict=True)
    noise = np.concatenate([(noisy.keypoints - clean.keypoints)[..., :2].ravel() for clean, noisy in pairs])
    assert noise.std() == pytest.approx(0.5 / 120, rel=0.05)
    assert np.concatenate([track.velocities.ravel() for track in found]).std() == pytest.approx(2e-3, rel=0.05)


def test_a_moving_arm_cannot_be_turned_round():
    moving = replace(TRAIN[0], velocities=np.full_like(TRAIN[0].velocities, 0.2))
    with pytest.raises(TrainingError, match=r"0\.2 rad/s.*without --augment"):
        backwards(moving)


class Killed(Exception):
    """Instead of kill -9."""


@pytest.mark.parametrize("epoch", [11, 15, 29])
def test_a_training_that_was_killed_goes_on_with_the_same_bits(epoch, tmp_path, monkeypatch):
    settings, path = replace(QUICK, epochs=30, patience=12), tmp_path / "checkpoint.safetensors"
    expected, curves = train_dynamics(TRAIN, settings)
    count = iter(range(epoch))

    def dying(*arguments):
        if next(count, None) is None:
            raise Killed
        return one_epoch(*arguments)

    one_epoch = training._epoch
    monkeypatch.setattr(training, "_epoch", dying)
    with pytest.raises(Killed):
        train_dynamics(TRAIN, settings, checkpoint=path)
    monkeypatch.setattr(training, "_epoch", one_epoch)
    torch.manual_seed(99)
    found, again = train_dynamics(TRAIN, settings, checkpoint=path)
    assert {name: values.tolist() for name, values in again.items()} == {k: v.tolist() for k, v in curves.items()}
    for name, value in expected.state_dict().items():
        assert torch.equal(found.state_dict()[name], value)


def test_a_checkpoint_of_other_settings_or_data_is_refused(tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    train_dynamics(TRAIN, QUICK, checkpoint=path)
    for tracks, settings in ((TRAIN, replace(QUICK, epochs=4)), (TRAIN[:-1], QUICK)):
        with pytest.raises(FileError, match="belongs to a training with other settings or data"):
            train_dynamics(tracks, settings, checkpoint=path)
