"""Dynamics from a user's own recordings, and velocities that are no more than rounding."""

import numpy as np
import pytest

pytest.importorskip("av")
pytest.importorskip("cv2")
pytest.importorskip("torch")
import torch

from kpirl_ocp.episodes import write_episodes
from kpirl_ocp.errors import EpisodeError
from kpirl_ocp.perception.data.recordings import ArmFilm, MeasuredArmFilm, read_arm_film
from kpirl_ocp.perception.detector.tracks import detect_tracks
from kpirl_ocp.perception.dynamics.model import DynamicsModel
from kpirl_ocp.perception.dynamics.training import DynamicsSettings, train_dynamics


class Detector:
    """Finds the brightest pixel, as one keypoint."""

    def detect(self, images):
        side = images.shape[1]
        rows, columns = np.divmod(images[..., 0].reshape(len(images), -1).argmax(axis=1), side)
        place = (np.column_stack([columns, rows]) + 0.5) / side * 2 - 1
        return np.concatenate([place, np.ones((len(images), 1))], axis=1)[:, None]


def own_film(seed, steps=12, side=32):
    """A one-joint robot that moves a bright dot; no masks, no velocities, no truth."""
    rng = np.random.default_rng(seed)
    actions = rng.uniform(-0.1, 0.1, (steps, 1))
    joints = np.vstack([[[0.0]], np.cumsum(actions, axis=0)])
    images = np.zeros((steps + 1, side, side, 3), np.uint8)
    for image, theta in zip(images, joints[:, 0], strict=True):
        image[int(side / 2 + 20 * theta), int(side / 2 + 30 * theta)] = 255
    return ArmFilm(images, joints, actions, np.arange(steps + 1) / 5)


def test_frames_joints_and_actions_are_all_that_training_needs(tmp_path):
    write_episodes(tmp_path, [own_film(seed) for seed in range(6)], {"robot": "mine"})
    tracks = detect_tracks(Detector(), tmp_path)
    assert tracks[0].keypoints.shape == (13, 1, 3)
    model, _ = train_dynamics(tracks, DynamicsSettings(epochs=3))
    assert model.sizes == {"keypoints": 2, "joints": 1, "velocities": 1, "actions": 1}


def test_velocities_are_measured_or_come_from_the_joints(tmp_path):
    film = own_film(0)
    write_episodes(tmp_path / "plain", [film], {})
    found = read_arm_film(tmp_path / "plain" / "episode_000.npz").velocities
    np.testing.assert_allclose(found[0], 0)
    np.testing.assert_allclose(found[1:], 5 * film.actions)
    measured = MeasuredArmFilm(film.images, film.joints, film.actions, film.times, np.ones((13, 1)))
    write_episodes(tmp_path / "measured", [measured], {})
    np.testing.assert_array_equal(read_arm_film(tmp_path / "measured" / "episode_000.npz").velocities, 1)


def test_a_film_without_joints_is_refused_with_the_key(tmp_path):
    np.savez(tmp_path / "episode_000.npz", timestamp=np.arange(3.0))
    with pytest.raises(EpisodeError, match=r"observation\.images\.camera"):
        read_arm_film(tmp_path / "episode_000.npz")


def test_velocities_that_are_rounding_move_no_keypoint():
    """An arm that rests at every look has velocities of 1e-5 rad/s; one of 1e-3 rad/s must then change little."""
    generator = torch.Generator().manual_seed(0)
    model = DynamicsModel(2, 3, "tanh")
    inputs = torch.randn(200, 11, generator=generator)
    inputs[:, 5:8] *= 1e-5
    model.normalise(inputs, 0.1 * torch.randn(200, 2, generator=generator))
    scale = model.get_buffer("input_scale")
    np.testing.assert_allclose(scale[5:8], 1e-2)
    assert (scale[[0, 1, 2, 3, 4, 8, 9, 10]] > 0.5).all()
    z, theta, u = torch.zeros(2), torch.zeros(3), torch.zeros(3)
    with torch.inference_mode():
        change = model(z, theta, torch.full((3,), 1e-3), u) - model(z, theta, torch.zeros(3), u)
    assert change.abs().max() < 0.02 * 0.1


def test_velocities_of_a_joint_that_never_moves_stay_unscaled():
    model = DynamicsModel(2, 1)
    inputs = torch.randn(50, 5, generator=torch.Generator().manual_seed(0))
    inputs[:, 3] = 0.0
    model.normalise(inputs, torch.randn(50, 2))
    assert model.get_buffer("input_scale")[3] == 1.0
