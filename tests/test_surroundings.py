"""Rendered clips in random surroundings: only the surroundings change, and the truth stays true."""

import numpy as np
import pytest

pytest.importorskip("cv2")
pytest.importorskip("pybullet")

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.perception.data import surroundings
from kpirl_ocp.perception.data.collection import collect
from kpirl_ocp.perception.data.motions import HandPlacing
from kpirl_ocp.perception.data.recordings import read_hand
from kpirl_ocp.perception.data.surroundings import clutter, filmed
from kpirl_ocp.perception.scene.frame import Frame

SIDE, OBJECT = 64, (30, 120, 60)


def clip(count=4):
    """A green square that moves before a wall, beside a grey body."""
    frames = []
    for index in range(count):
        parts = np.full((SIDE, SIDE), -1)
        parts[40:, :] = 7
        mask = np.zeros((SIDE, SIDE), bool)
        mask[20:36, 10 + 8 * index : 26 + 8 * index] = True
        parts[mask] = 9
        rgb = np.where(mask[..., None], OBJECT, np.where((parts == 7)[..., None], 128, 255)).astype(np.uint8)
        frames.append(Frame(rgb, mask, np.array([18.0 + 8 * index, 28.0]), parts))
    return frames


def rng(seed=0):
    return np.random.default_rng(seed)


def test_the_white_wall_is_left_as_it_is():
    frames = clip()
    assert filmed(frames, 0, rng()) == frames


def test_a_plain_wall_changes_the_wall_alone():
    frames = clip()
    for before, after in zip(frames, filmed(frames, 1, rng()), strict=True):
        wall = before.parts < 0
        np.testing.assert_array_equal(after.rgb[~wall], before.rgb[~wall])
        assert len(np.unique(after.rgb[wall], axis=0)) == 1
        assert (after.rgb[wall] != 255).any()
        assert after.place is before.place


def test_places_follow_the_shaken_camera_to_a_fraction_of_a_pixel():
    place, pixels = np.array([34.3, 29.8]), np.arange(SIDE) + 0.5
    heights = np.exp(-((pixels - place[0]) ** 2 + (pixels[:, None] - place[1]) ** 2) / (2 * 4.0**2))
    blob = Frame(np.repeat(np.round(250 * heights)[..., None], 3, 2).astype(np.uint8), heights > 2, place)
    for seed in range(6):
        (shaken,) = surroundings._shaken([blob], rng(seed))
        weights = shaken.rgb[..., 0] / shaken.rgb[..., 0].sum()
        centre = np.array([weights.sum(axis=0) @ pixels, weights.sum(axis=1) @ pixels])
        np.testing.assert_allclose(centre, shaken.place, atol=0.02)


@pytest.mark.parametrize("seed", range(6))
def test_clutter_light_shake_and_compression_keep_the_object_where_the_truth_has_it(seed):
    frames = filmed(clip(), 2, rng(seed))
    walls = {tuple(frame.rgb[2, 2]) for frame in frames}
    assert walls != {(255, 255, 255)}
    for frame in frames:
        rows, columns = np.nonzero(frame.bottle)
        np.testing.assert_allclose([columns.mean() + 0.5, rows.mean() + 0.5], frame.place, atol=0.7)
        colour = frame.rgb[frame.bottle].mean(axis=0)
        assert colour.argmax() == 1  # still green
        assert 0.75 < frame.bottle.sum() / 256 < 1.3


def test_any_level_is_the_same_for_the_same_seed_and_differs_between_seeds():
    one, same, other = (np.array([frame.rgb for frame in filmed(clip(), 3, rng(s))]) for s in (1, 1, 5))
    np.testing.assert_array_equal(one, same)
    assert (one != other).any()


def test_a_cluttered_wall_has_many_colours():
    wall = clutter(rng(), 48, 64)
    assert wall.shape == (48, 64, 3)
    assert len(np.unique(wall.reshape(-1, 3), axis=0)) > 100


def test_other_levels_are_refused():
    with pytest.raises(ProblemError, match="0, 1, 2 or 3"):
        filmed(clip(), 4, rng())


def test_a_data_set_is_collected_in_surroundings(tmp_path):
    directory = collect(tmp_path / "clutter", HandPlacing(rate=5, seconds=0.4, surroundings=2), 1)
    recording = read_hand(directory / "episode_000.npz")
    assert recording.images.shape == (3, 240, 240, 3)
    assert recording.bottle.any(axis=(1, 2)).all()
    corner = recording.images[:, :20, :20].reshape(-1, 3)
    assert corner.std(axis=0).max() > 3  # no white wall
