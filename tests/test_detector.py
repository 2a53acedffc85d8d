"""Training the keypoint detector, its checkpoints, its files and its scores."""

import json
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("cv2")
pytest.importorskip("torch")
import torch
from safetensors.numpy import load_file, save_file

from kpirl_ocp.assets import shipped_model
from kpirl_ocp.errors import FileError, ModelError, ProblemError, TrainingError
from kpirl_ocp.perception.data.recordings import Recording
from kpirl_ocp.perception.detector import losses
from kpirl_ocp.perception.detector.checkpoint import Checkpoint
from kpirl_ocp.perception.detector.detector import KeypointDetector
from kpirl_ocp.perception.detector.evaluation import on_mask, score
from kpirl_ocp.perception.detector.keypoints import local_soft_argmax
from kpirl_ocp.perception.detector.losses import LossWeights
from kpirl_ocp.perception.detector.training import PRESETS, TERMS, DetectorSettings, resize, train_detector

torch.set_num_threads(1)

TINY = DetectorSettings(
    size=16, keypoints=2, encoder="plain", filters=4, steps=120, batch=2, frames=3, step_size=3e-3, patience=1000
)


def film(seed, frames=8, side=48, square=12):
    """A recording of a red square that crosses a grey, noisy wall."""
    rng = np.random.default_rng(seed)
    ends = rng.uniform(square / 2, side - square / 2, (2, 2))
    places = np.linspace(*ends, frames).round()
    wall = rng.integers(100, 110, (side, side, 3))
    rows, columns = np.mgrid[:side, :side] + 0.5
    masks = np.array([(abs(columns - x) < square / 2) & (abs(rows - y) < square / 2) for x, y in places])
    images = np.where(masks[..., None], [220, 30, 30], wall).astype(np.uint8)
    return Recording(masks, places, np.arange(frames) / 5, images)


FILMS = [film(seed) for seed in range(8)]
CLIPS = [clip.images for clip in FILMS]


def assert_same(one, two):
    """Bit by bit."""
    for name in TERMS:
        np.testing.assert_array_equal(one.curves[name], two.curves[name])
    for (name, a), b in zip(one.model.state_dict().items(), two.model.state_dict().values(), strict=True):
        assert torch.equal(a, b), name


@pytest.fixture(scope="module")
def trained():
    return train_detector(CLIPS, TINY, seed=1)


# Training


def test_the_loss_falls_and_its_total_is_the_weighted_sum_of_its_terms(trained):
    assert set(trained.curves) == set(TERMS)
    total = trained.curves["total"]
    assert len(total) == TINY.steps
    assert total[-20:].mean() < 0.3 * total[:5].mean()
    weighted = sum(getattr(TINY.losses, name) * trained.curves[name] for name in TERMS[1:-1])
    np.testing.assert_allclose(total, trained.curves["reconstruction"] + weighted, rtol=1e-5)


def test_a_trained_detector_finds_the_square_in_films_it_has_not_seen():
    settings = replace(TINY, size=24, filters=8, batch=4, frames=4, steps=150)
    found = score(KeypointDetector(train_detector(CLIPS, settings).model, 24), [film(seed) for seed in range(100, 108)])
    assert found.on_mask.max() > 0.9, found
    assert found.error.min() < 3, found  # [pixels]; the square has 12, the image 48


@pytest.fixture
def batches(monkeypatch):
    """The clips of every step of training from here on; set `batches.end` to be killed in that step."""

    class Batches(list):
        end = None

    seen, reconstruction = Batches(), losses.reconstruction

    def watch(clips, painted):
        if len(seen) == seen.end:
            raise KeyboardInterrupt
        seen.append(clips)
        return reconstruction(clips, painted)

    monkeypatch.setattr(losses, "reconstruction", watch)
    return seen


def test_a_seed_repeats_weights_and_batches_and_another_differs(batches):
    short = replace(TINY, steps=3)
    one, two, other = (train_detector(CLIPS, short, seed=seed) for seed in (1, 1, 2))
    assert_same(one, two)
    assert not np.array_equal(one.curves["total"], other.curves["total"])
    assert torch.equal(batches[2], batches[5])
    assert not torch.equal(batches[2], batches[8])


def test_a_training_that_was_killed_goes_on_as_if_it_had_not_been(trained, tmp_path, batches):
    path = tmp_path / "deep" / "checkpoint.safetensors"
    batches.end = 110
    with pytest.raises(KeyboardInterrupt):
        train_detector(CLIPS, TINY, seed=1, checkpoint=path)
    del batches[:]
    assert_same(train_detector(CLIPS, TINY, seed=1, checkpoint=path), trained)
    assert len(batches) == 20  # steps 100 to 119
    assert_same(train_detector(CLIPS, TINY, seed=1, checkpoint=path), trained)
    assert len(batches) == 20  # it was finished
    assert [file.name for file in path.parent.iterdir()] == [path.name]


FROZEN = replace(TINY, step_size=0.0, patience=50, steps=200)


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A training that cannot get better, and its checkpoint."""
    path = tmp_path_factory.mktemp("stopped") / "checkpoint.safetensors"
    return train_detector(CLIPS, FROZEN, checkpoint=path), path


def test_training_stops_when_the_loss_no_longer_falls(stopped):
    assert len(stopped[0].curves["total"]) == 100  # the mean of the last 50 steps beside that of 50 steps ago


def test_a_training_that_stopped_at_a_plateau_takes_no_step_more(stopped):
    assert_same(train_detector(CLIPS, FROZEN, checkpoint=stopped[1]), stopped[0])


def test_the_stated_share_of_a_batch_comes_from_the_other_clips(batches):
    settings = replace(TINY, batch=8, other_share=0.25, steps=1)
    dark, light = ([np.full((5, 16, 16, 3), value, np.uint8)] for value in (0, 255))
    train_detector(dark, settings, others=light)
    train_detector(dark, settings)
    assert batches[0].shape == (8, 3, 3, 16, 16)
    assert sorted(batches[0].mean((1, 2, 3, 4)).tolist()) == 6 * [0.0] + 2 * [1.0]
    assert not batches[1].any()


def test_a_batch_holds_different_frames_of_a_clip_in_the_order_of_time(batches):
    clip = np.arange(6, dtype=np.uint8)[:, None, None, None] * np.ones((1, 16, 16, 3), np.uint8)
    train_detector([clip], replace(TINY, steps=1, batch=16))
    times = 255 * batches[0][:, :, 0, 0, 0]
    assert times.diff(dim=1).min() > 0.99
    assert len(times.round().unique(dim=0)) > 3


def test_training_takes_other_clips_and_weights_of_zero():
    added = dict.fromkeys(("repulsion", "cohesion", "attention", "appearance", "equivariance"), 0.0)
    published = replace(TINY, steps=2, losses=LossWeights(**added))
    curves = train_detector(CLIPS[:2], published, others=CLIPS[2:4]).curves
    assert not curves["equivariance"].any()
    weighted = sum(getattr(published.losses, name) * curves[name] for name in ("separation", "sparsity"))
    np.testing.assert_allclose(curves["total"], curves["reconstruction"] + weighted, rtol=1e-5)


NOTHING = LossWeights(**dict.fromkeys(LossWeights.__dataclass_fields__, 0.0))


def test_every_term_has_a_weight_and_the_published_losses_have_two():
    assert ("reconstruction", *LossWeights.__dataclass_fields__, "total") == TERMS
    published = PRESETS["minderer"].losses
    assert published == replace(NOTHING, separation=published.separation, sparsity=published.sparsity)


@pytest.mark.parametrize("name", LossWeights.__dataclass_fields__)
def test_a_weight_is_the_factor_of_its_own_term_alone(name, monkeypatch):
    monkeypatch.setattr(losses, "cohesion", partial(losses.cohesion, radius=1e-4))  # untrained keypoints are close
    settings = replace(TINY, steps=2, losses=replace(NOTHING, **{name: 7.0}))
    curves = train_detector(CLIPS, settings).curves
    assert np.abs(curves[name]).min() > 0
    np.testing.assert_allclose(curves["total"], curves["reconstruction"] + 7 * curves[name], rtol=1e-5)


def test_images_are_resized_by_area():
    image = np.zeros((1, 8, 8, 3), np.uint8)
    image[0, :4, :2] = 200
    np.testing.assert_array_equal(resize(image, 2)[0, :, :, 0], [[100, 0], [0, 0]])
    np.testing.assert_array_equal(resize(image, 8), image)


def test_all_presets_can_be_built_and_make_a_step():
    assert "default" in PRESETS
    for preset in PRESETS.values():
        settings = replace(preset, steps=1, batch=1, size=24)
        assert np.isfinite(train_detector(CLIPS, settings).curves["total"]).all()


@pytest.mark.parametrize(
    ("clips", "message"), [([], "there are none"), ([CLIPS[0], CLIPS[1][:2]], "at least 3 frames; the shortest has 2")]
)
def test_clips_that_are_too_short_or_none_are_refused(clips, message):
    with pytest.raises(TrainingError, match=message):
        train_detector(clips, TINY)


def test_a_loss_that_is_no_number_stops_the_training():
    with pytest.raises(TrainingError, match=r"the loss became .* smaller step size"):
        train_detector(CLIPS, replace(TINY, step_size=1e30, steps=5))


@pytest.mark.parametrize("name", ["keypoints", "filters", "steps", "batch", "frames", "patience"])
def test_training_of_nothing_is_refused(name):
    with pytest.raises(TrainingError, match=f"{name} must be at least 1, got 0"):
        replace(TINY, **{name: 0})


def test_a_single_keypoint_can_be_trained():
    assert np.isfinite(train_detector(CLIPS, replace(TINY, keypoints=1, steps=2)).curves["total"]).all()


# Checkpoints


def test_the_same_state_of_a_training_has_the_same_bytes(tmp_path):
    model = torch.nn.Linear(3, 2)
    optimiser = torch.optim.Adam(model.parameters())
    written = set()
    for index in range(20):
        stored = Checkpoint(tmp_path / str(index), {"seed": 0})
        stored.save(model, optimiser, {"total": [1.0]})
        written.add(stored.path.read_bytes())
        assert stored.load(model, optimiser, ("total",)) == {"total": [1.0]}
    assert len(written) == 1


@pytest.fixture
def checkpoint(tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    train_detector(CLIPS, replace(TINY, steps=2), checkpoint=path)
    return path


@pytest.mark.parametrize(("seed", "settings"), [(1, replace(TINY, steps=2)), (0, replace(TINY, steps=3))])
def test_a_checkpoint_of_other_settings_is_refused(checkpoint, seed, settings):
    with pytest.raises(FileError, match=f"{checkpoint.name} belongs to a training with other settings"):
        train_detector(CLIPS, settings, seed, checkpoint=checkpoint)


def test_a_damaged_checkpoint_is_named(checkpoint):
    whole = checkpoint.read_bytes()
    for content in (b"", b"hello", whole[:100], whole[: len(whole) // 2], whole[:-1]):
        checkpoint.write_bytes(content)
        with pytest.raises(FileError, match=f"{checkpoint.name} is no checkpoint.*Delete it"):
            train_detector(CLIPS, replace(TINY, steps=2), checkpoint=checkpoint)


def test_weights_that_are_no_checkpoint_are_refused(checkpoint):
    save_file({"x": np.zeros(3, np.float32)}, checkpoint)
    with pytest.raises(FileError, match="other settings"):
        train_detector(CLIPS, replace(TINY, steps=2), checkpoint=checkpoint)


# The detector and its files

CARD = {"architecture": {"size": 16, "keypoints": 2, "encoder": "plain", "filters": 4}, "training": {"seed": 1}}


@pytest.fixture(scope="module")
def detector(trained):
    return KeypointDetector(trained.model, 16)


@pytest.fixture
def saved(detector, tmp_path):
    return detector.save(tmp_path / "models" / "detector.json", CARD)


def test_a_detector_survives_the_disk_bit_by_bit(detector, saved):
    again = KeypointDetector.load(saved)
    np.testing.assert_array_equal(again.detect(CLIPS[0]), detector.detect(CLIPS[0]))
    assert json.loads(saved.read_text())["training"] == {"seed": 1}
    assert sorted(file.name for file in saved.parent.iterdir()) == ["detector.json", "detector.safetensors"]


def test_a_detection_is_the_sharpened_scores_of_the_resized_image(detector):
    images = np.concatenate(CLIPS)
    keypoints = detector.detect(images)
    assert keypoints.shape == (64, 2, 3)
    assert keypoints.dtype == np.float64
    frames = torch.from_numpy(resize(images, 16)).permute(0, 3, 1, 2) / 255
    with torch.no_grad():
        expected = local_soft_argmax(detector.model.encode(frames).scores)
    np.testing.assert_allclose(keypoints, expected, rtol=0, atol=1e-5)


def test_a_detection_is_the_same_bit_by_bit_on_any_number_of_threads():
    detector = KeypointDetector.load(shipped_model("detector"))
    images = np.concatenate([clip.images for clip in FILMS])
    found = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        found.append(detector.detect(images))
        assert torch.get_num_threads() == threads
    torch.set_num_threads(1)
    for other in found[1:]:
        np.testing.assert_array_equal(other, found[0])


def test_many_images_are_detected_as_each_by_itself(detector):
    images = np.concatenate([*CLIPS, *CLIPS])[:100]  # more than a batch
    alone = [detector.detect(images[i : i + 1])[0] for i in (0, 63, 64, 99)]
    np.testing.assert_allclose(detector.detect(images)[[0, 63, 64, 99]], alone, rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    "images", [CLIPS[0][0], CLIPS[0] / 255.0, CLIPS[0][:, :40], CLIPS[0][..., :1]], ids=["one", "float", "wide", "grey"]
)
def test_images_of_another_kind_are_refused(detector, images):
    with pytest.raises(ProblemError, match="square and"):
        detector.detect(images)


def test_no_images_give_no_keypoints(detector):
    assert detector.detect(CLIPS[0][:0]).shape == (0, 2, 3)


def test_a_missing_or_damaged_model_is_named(saved):
    weights = saved.with_suffix(".safetensors")
    whole = weights.read_bytes()
    for content in (b"", whole[:50], whole[:-1]):
        weights.write_bytes(content)
        with pytest.raises(ModelError, match=r"detector\.safetensors cannot be read as safetensors"):
            KeypointDetector.load(saved)
    weights.unlink()
    with pytest.raises(ModelError, match=r"no weight file .*detector\.safetensors"):
        KeypointDetector.load(saved)
    saved.write_text("{")
    with pytest.raises(ModelError, match=r"detector\.json"):
        KeypointDetector.load(saved)
    saved.unlink()
    with pytest.raises(ModelError, match=r"no model card .*detector\.json: train"):
        KeypointDetector.load(saved)


@pytest.mark.parametrize(("key", "value"), [("kind", "kpirl_ocp.dynamics"), ("version", 99)])
def test_a_model_of_another_kind_or_version_is_refused(saved, key, value):
    saved.write_text(json.dumps(json.loads(saved.read_text()) | {key: value}))
    with pytest.raises(ModelError, match=rf"detector\.json: '{key}' must be .*; it is .*{value}"):
        KeypointDetector.load(saved)


def test_weights_that_are_not_finite_are_named(saved):
    weights = saved.with_suffix(".safetensors")
    save_file(load_file(weights) | {"head.bias": np.full(2, np.nan, np.float32)}, weights)
    with pytest.raises(ModelError, match=r"detector\.safetensors: 'head\.bias' holds NaN"):
        KeypointDetector.load(saved)


@pytest.mark.parametrize(
    "card",
    [
        [1, 2],
        {"kind": "kpirl_ocp.detector", "version": 1},
        {"kind": "kpirl_ocp.detector", "version": 1, "architecture": CARD["architecture"] | {"filters": 8}},
    ],
    ids=["list", "without architecture", "other weights"],
)
def test_a_card_that_does_not_fit_its_weights_is_named(saved, card):
    saved.write_text(json.dumps(card))
    with pytest.raises(ModelError, match=r"detector"):
        KeypointDetector.load(saved)


# Scores


def scores(paths, films=FILMS):
    """Scores of keypoints (n, K, 2) [pixels] per film, as if a detector had found them there."""
    found = iter([np.concatenate([2 * path / 48 - 1, np.ones((*path.shape[:2], 1))], -1) for path in paths])
    return score(SimpleNamespace(detect=lambda images: next(found)), films)


def test_exact_keypoints_score_nothing_but_on_mask():
    found = scores([clip.place[:, None] for clip in FILMS])
    for value in (found.error, found.displacement, found.jitter):
        np.testing.assert_allclose(value, 0.0, atol=1e-10)
    np.testing.assert_array_equal(found.on_mask, 1.0)
    assert found.on_object == 1


def test_an_affine_map_of_the_truth_has_no_error_but_a_wrong_displacement():
    matrix, offset = np.array([[0.5, 0.3], [-0.2, 0.8]]), np.array([3.0, 9.0])
    found = scores([(clip.place @ matrix + offset)[:, None] for clip in FILMS])
    np.testing.assert_allclose([found.error[0], found.jitter[0]], 0.0, atol=1e-10)
    missed = [np.linalg.norm((clip.place - clip.place[0])[1:] @ (matrix - np.eye(2)), axis=1) for clip in FILMS]
    np.testing.assert_allclose(found.displacement, np.median(missed), rtol=1e-12)


def test_a_keypoint_that_stays_is_mapped_to_the_mean_of_the_other_half():
    found = scores([np.full((8, 1, 2), 7.0) for _ in FILMS])
    places = np.array([clip.place for clip in FILMS])
    guesses = [places[1 - index % 2 :: 2].mean(axis=(0, 1)) for index in range(len(FILMS))]
    distances = [np.linalg.norm(place - guess, axis=1) for place, guess in zip(places, guesses, strict=True)]
    np.testing.assert_allclose(found.error, np.mean(distances), rtol=1e-10)
    moved = np.linalg.norm(places[:, 1:] - places[:, :1], axis=-1)
    np.testing.assert_allclose(found.displacement, np.median(moved), rtol=1e-12)
    jumps = np.diff(places, axis=1)
    np.testing.assert_allclose(found.jitter, np.sqrt((jumps**2).sum(axis=-1).mean()), rtol=1e-10)


def test_keypoints_are_scored_one_by_one():
    rng = np.random.default_rng(0)
    both = [np.stack([clip.place, rng.uniform(0, 48, (8, 2))], 1) for clip in FILMS]
    found, alone = scores(both), scores([path[:, 1:] for path in both])
    assert found.error[0] < 1e-10
    for name in ("error", "on_mask", "displacement", "jitter"):
        np.testing.assert_allclose(getattr(found, name)[1], getattr(alone, name)[0], rtol=1e-12)


def test_the_map_is_not_fitted_on_the_clips_it_is_measured_on():
    """A map that could only be known from the measured clips themselves: the even ones are mirrored."""
    turned = [(clip.place if index % 2 else 48 - clip.place)[:, None] for index, clip in enumerate(FILMS)]
    places = np.concatenate([clip.place for clip in FILMS])
    np.testing.assert_allclose(scores(turned).error, np.linalg.norm(2 * places - 48, axis=1).mean(), rtol=1e-10)


def test_jitter_of_white_noise_is_its_step_from_frame_to_frame():
    rng = np.random.default_rng(1)
    films = [film(seed, frames=80) for seed in range(20)]
    found = scores([clip.place[:, None] + rng.normal(0, 0.5, (80, 1, 2)) for clip in films], films)
    np.testing.assert_allclose(found.jitter, 0.5 * 2, rtol=0.1)  # sqrt(2 axes * 2 frames) deviations
    np.testing.assert_allclose(found.error, 0.5 * np.sqrt(np.pi / 2), rtol=0.1)  # Rayleigh's mean


def test_on_mask_reads_rows_down_and_columns_to_the_right():
    masks = np.zeros((2, 30, 40), bool)
    masks[0, 11, 24] = masks[1, 29, 39] = True
    inside = [[24.0, 11.0], [24.99, 11.99], [25.0, 11.5], [11.5, 24.0]]
    corner = [[39.5, 29.5], [40.0, 30.0], [99.0, 99.0], [0, 0]]
    found = on_mask(np.array([inside, corner]), masks)
    np.testing.assert_array_equal(found, [[True, True, False, False], [True, True, True, False]])


def covered(mask):
    """The pixels (H, W) in the middle of which a keypoint is on the mask."""
    rows, columns = np.indices(mask.shape)
    return on_mask(np.stack([columns, rows], -1).reshape(1, -1, 2) + 0.5, mask[None]).reshape(mask.shape)


def box(rows, columns, shape=(50, 60)):
    mask = np.zeros(shape, bool)
    mask[slice(*rows), slice(*columns)] = True
    return mask


@pytest.mark.parametrize("axis", ["down", "across"])
@pytest.mark.parametrize("gap", [1, 6, 8])
def test_a_finger_across_the_object_counts_as_on_it_and_the_outside_does_not_grow(gap, axis):
    whole = box((10, 40), (12, 45))
    finger = box((0, 50), (25, 25 + gap)) if axis == "down" else box((20, 20 + gap), (0, 60))
    np.testing.assert_array_equal(covered(whole & ~finger), whole)


def test_a_wide_gap_stays_a_gap_and_masks_are_closed_frame_by_frame():
    apart = box((10, 40), (12, 45)) & ~box((0, 50), (22, 34))
    np.testing.assert_array_equal(covered(apart), apart)
    one, other = box((10, 40), (12, 25)), box((10, 40), (31, 45))  # a gap of 6, but in two frames
    middle = np.full((2, 1, 2), [28.0, 25.0])
    np.testing.assert_array_equal(on_mask(middle, np.array([one, other])), [[False], [False]])
    np.testing.assert_array_equal(on_mask(middle, np.array([one | other, other])), [[True], [False]])


@pytest.mark.parametrize("rows", [(0, 20), (30, 50), (5, 45)])
def test_a_mask_without_gaps_stays_as_it_is_also_at_the_edge_of_the_image(rows):
    for whole in (box(rows, (12, 45)), box(rows, (0, 60)), box(rows, (0, 1)), np.zeros((50, 60), bool)):
        np.testing.assert_array_equal(covered(whole), whole)


def test_a_mask_near_the_edge_of_the_image_does_not_grow_to_it():
    whole = box((3, 20), (12, 45))
    np.testing.assert_array_equal(covered(whole), whole)


def test_a_keypoint_counts_as_on_the_object_from_four_fifths_of_the_frames():
    films = [film(seed, frames=10) for seed in range(2)]
    away = np.array([47.9, 0.1])
    shares = []
    for kept in (7, 8):
        path = [np.where(np.arange(10)[:, None] < kept, clip.place, away)[:, None] for clip in films]
        assert not films[0].bottle[:, 0, 47].any()
        shares.append(scores(path, films))
    assert [float(found.on_mask[0]) for found in shares] == [0.7, 0.8]
    assert [found.on_object for found in shares] == [0, 1]


def test_scores_need_two_clips():
    with pytest.raises(TrainingError, match="at least two clips, got 1"):
        scores([FILMS[0].place[:, None]], FILMS[:1])
