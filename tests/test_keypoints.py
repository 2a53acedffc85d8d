"""Scores and keypoints, the terms of the detector's loss, and its network: closed forms first."""

import numpy as np
import pytest

pytest.importorskip("torch")
import torch

from kpirl_ocp.perception.detector import losses
from kpirl_ocp.perception.detector.autoencoder import BasicBlock, Encoded, KeypointAutoencoder
from kpirl_ocp.perception.detector.keypoints import (
    cell_centres,
    gaussian_maps,
    local_soft_argmax,
    soft_argmax,
    spatial_softmax,
    to_pixels,
)

torch.set_num_threads(1)

CELLS = 15
WIDTH = 0.1  # of separation and repulsion


def assert_close(actual, expected, atol=1e-6):
    np.testing.assert_allclose(torch.as_tensor(actual).detach(), torch.as_tensor(expected).detach(), rtol=0, atol=atol)


def scores_of(probability):
    """Scores whose `spatial_softmax` is proportional to a map that is nowhere negative."""
    return torch.log(torch.as_tensor(probability))


def scores_with_heat(heat):
    """Scores whose softplus is `heat`."""
    return torch.log(torch.expm1(torch.as_tensor(heat)))


def peaks(*cells, size=CELLS):
    """One map per (row, column), zero but for a one there."""
    heat = torch.zeros(len(cells), size, size)
    for k, (row, column) in enumerate(cells):
        heat[k, row, column] = 1.0
    return heat


# Keypoints


def test_the_image_reaches_from_minus_one_to_one():
    assert_close(to_pixels([[-1, -1], [0, 0], [1, 1], [0.5, -0.5]], 240), [[0, 0], [120, 120], [240, 240], [180, 60]])
    assert_close(to_pixels([[0.5, -0.5, 0.3]], 240), [[180, 60]])  # mu is no place


def test_the_centre_of_a_cell_is_in_the_middle_of_its_pixels():
    assert_close(
        to_pixels(torch.stack([cell_centres(60), cell_centres(60)], -1), 240)[:, 0], 4 * np.arange(60) + 2.0, atol=1e-4
    )
    assert_close(cell_centres(4), [-0.75, -0.25, 0.25, 0.75])


@pytest.mark.parametrize(("row", "column"), [(0, 0), (3, 11), (14, 7)])
def test_the_expectation_of_a_single_cell_is_its_centre(row, column):
    x, y = (2 * column + 1) / CELLS - 1, (2 * row + 1) / CELLS - 1
    for read in (soft_argmax, local_soft_argmax):
        assert_close(read(scores_of(peaks((row, column)))), [[x, y, 1.0]])


def test_a_spot_is_a_distribution_over_the_cells_that_no_constant_changes():
    scores = torch.randn(2, 3, 4, 5, generator=torch.Generator().manual_seed(6))
    assert_close(spatial_softmax(scores).sum((-2, -1)), torch.ones(2, 3))
    assert_close(
        spatial_softmax(scores)[1, 2, 3, 4] / spatial_softmax(scores)[1, 2, 0, 1],
        torch.exp(scores[1, 2, 3, 4] - scores[1, 2, 0, 1]),
    )
    assert_close(spatial_softmax(scores + 7.0), spatial_softmax(scores))


def test_a_spot_is_the_share_of_each_cell_for_scores_of_any_size():
    heat = torch.rand(2, 3, 5, 7, generator=torch.Generator().manual_seed(7))
    assert_close(spatial_softmax(scores_of(heat)), heat / heat.sum((-2, -1), keepdim=True))
    assert_close(spatial_softmax(torch.full((2, 5, 7), -8.0)), torch.full((2, 5, 7), 1 / 35))
    assert_close(
        spatial_softmax(np.log(3) * peaks((1, 2), size=3)), (torch.ones(1, 3, 3) + 2 * peaks((1, 2), size=3)) / 11
    )
    for constant in (-1e4, 1e4):
        assert_close(spatial_softmax(1e4 * peaks((3, 5)) + constant), peaks((3, 5)))


def test_the_expectation_of_two_equal_cells_is_half_way_and_of_a_uniform_map_the_middle():
    heat = peaks((2, 4)) + peaks((6, 12))
    assert_close(soft_argmax(scores_of(heat))[0, :2], soft_argmax(scores_of(peaks((4, 8))))[0, :2])
    assert_close(soft_argmax(torch.ones(1, CELLS, 9)), [[0.0, 0.0, 1.0]])


def test_a_shift_of_the_scores_shifts_the_keypoints_by_the_same():
    heat = torch.zeros(3, CELLS, CELLS)
    heat[:, 3:8, 2:7] = torch.rand(3, 5, 5, generator=torch.Generator().manual_seed(0))
    moved = torch.roll(heat, (4, 6), (1, 2))
    for read in (soft_argmax, local_soft_argmax):
        assert_close(
            read(scores_of(moved)) - read(scores_of(heat)),
            torch.tensor([6 * 2 / CELLS, 4 * 2 / CELLS, 0.0]).expand(3, 3),
        )


def test_mu_is_the_mean_heat_beside_the_largest():
    heat = torch.stack([torch.full((8, 8), 0.5), torch.full((8, 8), 2.0), torch.full((8, 8), 1.0)])
    for read in (soft_argmax, local_soft_argmax):
        assert_close(read(scores_with_heat(heat))[:, 2], [0.25, 1.0, 0.5])
    heat[0, :4], heat[0, 4:] = 0.2, 0.8  # uneven; its mean is still 0.5
    alone = peaks((1, 1), (2, 2), size=8) * torch.tensor([1.0, 3.0])[:, None, None]
    for read in (soft_argmax, local_soft_argmax):
        assert_close(read(scores_with_heat(heat))[:, 2], [0.25, 1.0, 0.5])
        assert_close(read(scores_of(alone))[:, 2], [0.5, 1.0])  # log(1 + 1) / log(1 + 3)
        assert_close(read(torch.stack([torch.zeros(8, 8), torch.full((8, 8), 50.0)]))[:, 2], [np.log(2) / 50, 1.0])


def test_frames_of_a_batch_are_read_one_by_one():
    anything = torch.randn(2, 3, 4, CELLS, CELLS, generator=torch.Generator().manual_seed(1))
    for read in (soft_argmax, local_soft_argmax, spatial_softmax):
        assert_close(read(anything)[1, 2], read(anything[1, 2]))


def test_sharpened_ignores_a_weaker_peak_far_away_and_expectation_does_not():
    heat = peaks((4, 4)) + 0.8 * peaks((12, 11))
    assert_close(local_soft_argmax(scores_of(heat))[0, :2], soft_argmax(scores_of(peaks((4, 4))))[0, :2])
    assert (soft_argmax(scores_of(heat))[0, :2] - local_soft_argmax(scores_of(heat))[0, :2]).abs().min() > 0.3


def test_sharpened_keeps_what_is_within_its_radius_also_at_the_edge():
    heat = peaks((0, 0)) + 0.5 * peaks((2, 2)) + 0.5 * peaks((0, 3))
    near = peaks((0, 0)) + 0.5 * peaks((2, 2))
    assert_close(local_soft_argmax(scores_of(heat))[0, :2], soft_argmax(scores_of(near))[0, :2])
    anything = torch.rand(2, CELLS, CELLS, generator=torch.Generator().manual_seed(2))
    assert_close(local_soft_argmax(anything, radius=CELLS), soft_argmax(anything))


def test_a_gaussian_map_has_height_mu_at_its_keypoint_and_falls_with_its_width():
    x, y = float(cell_centres(CELLS)[9]), float(cell_centres(CELLS)[4])
    maps = gaussian_maps(torch.tensor([[x, y, 0.7]]), CELLS, width=2.0)[0]
    assert divmod(int(maps.argmax()), CELLS) == (4, 9)  # rows are y, columns are x
    assert_close(maps[4, [9, 11, 7]], 0.7 * np.exp([0.0, -0.5, -0.5]))
    assert_close(maps[8, 9], 0.7 * np.exp(-2.0))
    assert_close(maps[6, 11], 0.7 * np.exp(-1.0))


def test_keypoints_survive_gaussian_maps_and_expectation():
    rng = np.random.default_rng(3)
    keypoints = torch.from_numpy(np.column_stack([rng.uniform(-0.2, 0.2, (5, 2)), [1, 0.9, 0.5, 0.2, 0.1]])).float()
    maps = scores_of(gaussian_maps(keypoints, 25))
    for places in (soft_argmax(maps), local_soft_argmax(maps, radius=12)):
        assert_close(places[:, :2], keypoints[:, :2], 1e-5)
    faint = maps + np.log(1e-5)  # log(1 + h) is h
    for places in (soft_argmax(faint), local_soft_argmax(faint, radius=12)):
        assert_close(places, keypoints, 1e-5)


# Losses


def clip_of_paths(*paths):
    """Keypoints (1, T, K, 3) that follow paths (T, 2)."""
    positions = torch.as_tensor(np.stack(paths, 1), dtype=torch.float32)[None]
    return torch.cat([positions, torch.ones(*positions.shape[:-1], 1)], -1)


WAVE = np.column_stack([0.3 * np.sin(np.arange(8)), 0.3 * np.cos(np.arange(8))])
STILL = np.zeros((8, 2))
SWITCH = np.column_stack([0.1 * (-1.0) ** np.arange(8), np.zeros(8)])  # mean square 0.1^2 about its mean


def test_separation_is_one_for_parallel_paths_wherever_they_are():
    assert_close(losses.separation(clip_of_paths(WAVE, WAVE + 0.5, WAVE - 0.2)), 1.0)


def test_separation_of_two_paths_is_the_exponential_of_their_mean_squared_distance():
    assert_close(losses.separation(clip_of_paths(SWITCH, STILL)), np.exp(-(0.1**2) / (2 * WIDTH**2)))
    assert_close(losses.separation(clip_of_paths(SWITCH, -SWITCH)), np.exp(-(0.2**2) / (2 * WIDTH**2)))
    assert losses.separation(clip_of_paths(5 * SWITCH, -5 * SWITCH)) < 1e-20


def test_separation_is_the_mean_over_pairs_and_over_clips():
    alike = np.exp(-(0.1**2) / (2 * WIDTH**2))
    three = clip_of_paths(SWITCH, STILL, STILL)  # pairs: alike, alike, 1
    assert_close(losses.separation(three), (2 * alike + 1) / 3)
    assert_close(losses.separation(torch.cat([three, clip_of_paths(WAVE, WAVE, WAVE)])), ((2 * alike + 1) / 3 + 1) / 2)


def test_repulsion_is_one_on_one_spot_and_falls_with_the_distance():
    assert_close(losses.repulsion(clip_of_paths(WAVE, WAVE, WAVE)), 1.0)
    assert_close(losses.repulsion(clip_of_paths(WAVE, WAVE + np.array([0.1, 0.0]))), np.exp(-0.5))
    assert_close(losses.repulsion(clip_of_paths(WAVE, WAVE + np.array([0.06, 0.08]), WAVE)), (2 * np.exp(-0.5) + 1) / 3)
    assert losses.repulsion(clip_of_paths(WAVE, WAVE + 1.0)) < 1e-20


def test_cohesion_is_the_mean_distance_outside_the_circle_around_the_middle():
    apart = clip_of_paths(WAVE, WAVE + np.array([0.0, 0.36]))
    assert_close(losses.cohesion(apart), 0.10)  # each is 0.18 from their middle, 0.08 are free
    assert_close(losses.cohesion(clip_of_paths(WAVE, WAVE + np.array([0.12, 0.0]))), 0.0)


def test_cohesion_of_keypoints_on_one_spot_has_no_gradient_and_no_nan():
    keypoints = clip_of_paths(WAVE, WAVE).requires_grad_()
    losses.cohesion(keypoints).backward()
    assert not keypoints.grad.any()


def test_only_positions_are_kept_together_or_apart():
    keypoints = clip_of_paths(WAVE, SWITCH)
    faint = keypoints * torch.tensor([1.0, 1.0, 0.1])
    for term in (losses.separation, losses.repulsion, losses.cohesion):
        assert_close(term(faint), term(keypoints))


@pytest.mark.parametrize("size", [16, 60, 64, 120])
def test_reconstruction_of_an_even_error_is_the_same_for_every_image_size(size):
    clips = torch.full((2, 3, 3, size, size), 0.5)
    assert_close(losses.reconstruction(clips, clips), 0.0)
    assert_close(losses.reconstruction(clips, clips + 0.1), 0.5 * 3 * 64**2 * 0.1**2, atol=1e-3)


def test_reconstruction_is_half_the_squared_error_averaged_over_frames():
    clips, painted = torch.zeros(2, 2, 3, 64, 64), torch.zeros(2, 2, 3, 64, 64)
    painted[1, 0, 2, 5, 7] = 4.0
    assert_close(losses.reconstruction(clips, painted), 0.5 * 16 / 4)


def test_sparsity_is_the_mean_heat():
    heat = torch.stack([torch.ones(2, 3, 4, 4), 3 * torch.ones(2, 3, 4, 4)])
    assert_close(losses.sparsity(scores_with_heat(heat)), 2.0)
    assert_close(losses.sparsity(torch.zeros(2, 3, 2, 4, 4)), np.log(2))
    assert_close(losses.sparsity(scores_of(peaks((0, 1), (2, 3), size=4))[None]), np.log(2) / 16)


def test_motion_is_how_much_a_frame_differs_from_the_usual_one_beside_the_largest_difference():
    clips = torch.full((2, 5, 3, 16, 16), 0.3)
    clips[0, 3, :, 4:8, 8:12] = 0.9  # a cell of a 4 x 4 grid
    clips[0, 2, :, 12:14, 0:4] = 0.9  # half a cell
    clips[0, 1, :, 0:2, 0:1] = 0.9  # an eighth of a cell
    clips[0, 4, :, 0:2, 4:5] = -0.3  # as much the other way
    expected = torch.zeros(2, 5, 4, 4)
    expected[0, 3, 1, 2], expected[0, 2, 3, 0] = 1.0, 0.5
    expected[0, 1, 0, 0] = expected[0, 4, 0, 1] = 0.125
    assert_close(losses.motion(clips, 4), expected)


def test_motion_is_linear_sums_colours_is_measured_clip_by_clip_and_does_not_enlarge_noise():
    clips = torch.full((3, 5, 3, 8, 8), 0.5)
    clips[0, 1, 0, :4, :4] = 0.6  # one colour
    clips[0, 2, :, :4, 4:] = 0.6  # three colours, the largest change of this clip
    clips[0, 3, 1, 4:, :4] = 0.35  # half of that, the other way
    clips[1, 1, 0, :4, :4] = 0.5 + 2.5e-4
    clips[2, 4, 2, 4:, 4:] = 0.52
    expected = torch.zeros(3, 5, 2, 2)
    expected[0, 1, 0, 0], expected[0, 2, 0, 1], expected[0, 3, 1, 0] = 1 / 3, 1.0, 1 / 2
    expected[1, 1, 0, 0] = 1 / 4  # of 1e-3, the least change that is full
    expected[2, 4, 1, 1] = 1.0
    assert_close(losses.motion(clips, 2), expected, atol=1e-3)


def test_attention_is_the_logarithm_of_the_share_of_mass_that_moves():
    moving = torch.zeros(1, 1, 4, 4)
    moving[0, 0, 1, :] = 1.0
    on, off = (scores_of(peaks(cell, size=4))[None, None] for cell in ((1, 2), (3, 2)))
    assert_close(losses.attention(on, moving), -np.log(1e-3 + 1))
    assert_close(losses.attention(off, moving), -np.log(1e-3), atol=1e-5)
    assert_close(losses.attention(torch.ones(1, 1, 3, 4, 4), moving), -np.log(1e-3 + 1 / 4))
    both = scores_of(peaks((1, 2), size=4) + 2 * peaks((3, 2), size=4))[None, None]
    assert_close(losses.attention(both, moving), -np.log(1e-3 + 1 / 3))
    assert_close(losses.attention(both, 0.3 * moving), -np.log(1e-3 + 0.1))
    assert_close(losses.attention(torch.cat([on, off], 2), moving), -0.5 * (np.log(1e-3 + 1) + np.log(1e-3)), atol=1e-5)
    assert_close(losses.attention(on + 7, moving), losses.attention(on, moving))


def test_appearance_is_the_variance_of_the_colour_under_a_keypoint():
    clips = torch.zeros(2, 1, 3, 16, 16)
    clips[1, :, 0, :8], clips[:, :, 1, 8:] = 0.6, 0.9  # above: black in one clip and red in the other; below: green
    above, below = (scores_of(peaks(cell, size=4)).expand(2, 1, 1, 4, 4) for cell in ((1, 2), (3, 2)))
    assert_close(losses.appearance(clips, below), 0.0)
    assert_close(losses.appearance(clips, above), 0.3**2)
    assert_close(losses.appearance(clips, torch.cat([above, below], 2)), 0.3**2 / 2)


RED, BLUE = torch.tensor([0.9, 0.1, 0.2]), torch.tensor([0.3, 0.0, 0.7])
DIFFERENCE = 0.6**2 + 0.1**2 + 0.5**2  # squared


@pytest.mark.parametrize("blue", [[], [(0, 0)], [(0, 0), (0, 1), (0, 2), (0, 3)], [(0, 1), (1, 1), (1, 3)]])
def test_appearance_of_two_colours_is_the_variance_of_a_coin_over_frames_and_clips(blue):
    clips = torch.rand(2, 4, 3, 16, 16, generator=torch.Generator().manual_seed(9))  # elsewhere: anything
    clips[..., 4:8, 8:12] = RED[:, None, None]
    for clip, frame in blue:
        clips[clip, frame, :, 4:8, 8:12] = BLUE[:, None, None]
    share = len(blue) / 8
    where = scores_of(peaks((1, 2), size=4)).expand(2, 4, 1, 4, 4)
    assert_close(losses.appearance(clips, where), share * (1 - share) * DIFFERENCE)


def test_appearance_sees_a_keypoint_that_leaves_for_another_colour_and_weighs_by_its_spot():
    clips = RED[:, None, None].repeat(1, 3, 1, 8, 8)
    clips[..., 4:] = BLUE[:, None, None]  # the right half
    left, right = (scores_of(peaks(cell, size=4)) for cell in ((1, 1), (1, 2)))
    between = scores_of(3 * peaks((1, 1), size=4) + peaks((1, 2), size=4))  # a quarter to the right
    anything = torch.randn(1, 3, 2, 4, 4, generator=torch.Generator().manual_seed(10))
    assert_close(losses.appearance(clips, torch.stack([left, left, left])[None]), 0.0)
    assert_close(losses.appearance(clips, torch.stack([left, right, left])[None]), 2 / 9 * DIFFERENCE)
    assert_close(losses.appearance(clips, torch.stack([left, between, left])[None]), 2 / 9 * DIFFERENCE / 16)
    assert_close(losses.appearance(clips[..., :1].expand_as(clips), anything), 0.0)  # one colour everywhere


@pytest.mark.parametrize(("right", "down"), [(3, 0), (0, 2), (-4, 5)])
def test_shifted_moves_pixels_right_and_down_by_half_a_side_per_unit(right, down):
    frames = torch.rand(2, 3, 20, 20, generator=torch.Generator().manual_seed(4))
    offset = torch.tensor([[2 * right / 20, 2 * down / 20], [0.0, 0.0]])
    moved = losses.shifted(frames, offset)
    rows = torch.arange(20).sub(down).clamp(0, 19)  # edges are continued
    columns = torch.arange(20).sub(right).clamp(0, 19)
    assert_close(moved[0], frames[0][:, rows][:, :, columns], atol=1e-5)
    assert_close(moved[1], frames[1], atol=1e-5)


def test_keypoints_of_shifted_heat_are_the_shifted_keypoints():
    keypoints = torch.tensor([[-0.1, 0.2, 1.0], [0.15, 0.05, 1.0], [0.0, -0.2, 1.0]])
    offset = torch.tensor([[0.237, -0.111]])
    moved = soft_argmax(scores_of(losses.shifted(gaussian_maps(keypoints, 40)[None], offset)))
    assert_close(moved[0, :, :2], keypoints[:, :2] + offset, atol=1e-4)
    assert_close(losses.equivariance(moved, keypoints[None], offset), 0.0, atol=1e-4)


def test_equivariance_is_nothing_for_a_perfect_detector_and_the_shift_for_one_that_does_not_look():
    keypoints = torch.tensor([[[0.1, 0.2, 1.0], [-0.3, 0.0, 0.5]]])
    offset = torch.tensor([[0.2, -0.3]])
    moved = keypoints + torch.tensor([0.2, -0.3, 0.0])
    assert_close(losses.equivariance(moved, keypoints, offset), 0.0)
    assert_close(losses.equivariance(keypoints, keypoints, offset), 0.25)


def test_equivariance_does_not_ask_for_keypoints_outside_the_image():
    keypoints = torch.tensor([[[0.9, 0.0, 1.0], [0.0, 0.0, 1.0]]])
    offset = torch.tensor([[0.2, 0.0]])
    assert_close(
        losses.equivariance(keypoints, keypoints, offset), 0.2 / 4
    )  # of four numbers, only x of the second counts


def test_equivariance_teaches_the_shifted_view_only():
    keypoints = torch.zeros(1, 2, 3, requires_grad=True)
    moved = torch.zeros(1, 2, 3, requires_grad=True)
    losses.equivariance(moved, keypoints, torch.tensor([[0.2, 0.1]])).backward()
    assert keypoints.grad is None
    assert moved.grad[..., :2].abs().min() > 0


# The network


@pytest.fixture(params=["resnet", "plain"])
def model(request):
    torch.manual_seed(0)
    return KeypointAutoencoder(24, keypoints=3, kind=request.param, filters=4)


@pytest.fixture
def clips():
    return torch.rand(2, 5, 3, 24, 24, generator=torch.Generator().manual_seed(5))


def test_a_map_of_scores_has_a_quarter_of_the_side_of_the_image(model, clips):
    features, scores, keypoints = model.encode(clips[0])
    assert features.shape == (5, 8, 6, 6)
    assert scores.shape == (5, 3, 6, 6)
    assert keypoints.shape == (5, 3, 3)
    assert (keypoints[..., :2].abs() < 1).all()
    assert_close(keypoints[..., 2].amax(-1), torch.ones(5))
    assert_close(keypoints, soft_argmax(scores))


def test_the_forward_pass_encodes_each_frame_by_itself(model, clips):
    painted, keypoints, scores = model(clips)
    assert painted.shape == clips.shape
    assert keypoints.shape == (2, 5, 3, 3)
    assert scores.shape == (2, 5, 3, 6, 6)
    assert_close(keypoints[1, 3], model.encode(clips[1, 3:4]).keypoints[0], atol=1e-5)


def test_the_decoder_predicts_a_change_of_the_first_frame(model, clips):
    torch.nn.init.zeros_(model.decoder[-1].weight)
    torch.nn.init.constant_(model.decoder[-1].bias, 0.25)
    painted, _, _ = model(clips)
    assert_close(painted, clips[:, :1].expand_as(clips) + 0.25)


def test_of_a_later_frame_the_decoder_sees_the_keypoints_only(model, clips):
    encoded = Encoded(*(values.detach() for values in model.encode(clips[0])))
    painted = []
    for noise in (0.0, 1.0):  # on all that the encoder says of the later frames but their keypoints
        later = torch.cat([torch.zeros(1), torch.full((4,), noise)])[:, None, None, None]
        model.encode = lambda _, later=later: Encoded(
            encoded.features + later, encoded.scores + later, encoded.keypoints
        )
        painted.append(model(clips[:1])[0])
    assert torch.equal(*painted)


def test_the_decoder_sees_all_keypoints_and_the_features_of_the_first_frame(model, clips):
    encoded = Encoded(*(values.detach() for values in model.encode(clips[0])))
    features, keypoints = encoded.features.requires_grad_(), encoded.keypoints.requires_grad_()
    model.encode = lambda _: Encoded(features, encoded.scores, keypoints)
    model(clips[:1])[0][0, 3].square().sum().backward()
    assert [bool(features.grad[t].any()) for t in range(5)] == [True, False, False, False, False]
    assert [bool(keypoints.grad[t].any()) for t in range(5)] == [True, False, False, True, False]


def test_every_weight_takes_part_in_the_training(model, clips):
    painted, keypoints, _ = model(clips)
    (painted.square().sum() + keypoints.square().sum()).backward()
    idle = [name for name, weight in model.named_parameters() if weight.grad is None or not weight.grad.any()]
    assert idle == []


def test_a_block_of_few_channels_and_a_stride_has_the_gradient_of_double_precision():
    torch.manual_seed(0)
    block = BasicBlock(4, 8, stride=2)
    x = torch.rand(10, 4, 12, 12).contiguous(memory_format=torch.channels_last)

    def gradients(dtype):
        block.to(dtype).zero_grad()
        block(x.to(dtype)).square().mean().backward()
        return [weight.grad.clone().double() for weight in block.parameters()]

    for single, double in zip(gradients(torch.float32), gradients(torch.float64), strict=True):
        assert_close(single, double, atol=1e-5 * double.abs().max().item())


def test_an_image_size_that_is_no_multiple_of_four_is_refused():
    with pytest.raises(ValueError, match="multiple of 4, got 30"):
        KeypointAutoencoder(30)
