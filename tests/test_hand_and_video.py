"""A hand's demonstration, and videos on disk."""

import numpy as np
import pytest

pytest.importorskip("cv2")
pytest.importorskip("pybullet")

import cv2

from kpirl_ocp.errors import FileError, ProblemError, SceneError
from kpirl_ocp.perception.data.encoding import write_video
from kpirl_ocp.perception.data.video import read_demonstration
from kpirl_ocp.perception.scene.hand import RATE, HandScene, placing_path


@pytest.fixture(scope="module")
def film():
    with HandScene() as scene:
        return scene.film(placing_path(np.random.default_rng(0)))


def test_the_hand_moves_along_x_then_down_like_a_person():
    path = placing_path(np.random.default_rng(1), tremor=0.0)
    assert path.shape == (61, 3)
    half = len(path) // 2
    np.testing.assert_array_equal(path[: half + 1, 2], path[0, 2])
    np.testing.assert_array_equal(path[half:, 0], path[-1, 0])
    speed = np.linalg.norm(np.diff(path, axis=0), axis=1) * RATE  # [m/s]
    assert speed[[0, half - 1, half, -1]].max() < 0.05 * speed.max()  # at rest before, between and after
    assert 0.2 < speed.max() < 0.7


def test_the_tremor_has_the_size_that_is_asked_for_and_repeats_for_a_seed():
    still, shaky, again = (
        placing_path(np.random.default_rng(2), seconds=60, tremor=tremor) for tremor in (0.0, 2e-3, 2e-3)
    )
    np.testing.assert_allclose((shaky - still).std(axis=0), 2e-3, rtol=0.2)
    np.testing.assert_array_equal(shaky, again)


def test_the_bottle_is_where_the_hand_holds_it():
    with HandScene() as scene:
        for position in ([0.5, 0.0, 0.6], [0.68, 0.0, 0.415]):
            rows, columns = np.nonzero(scene.look(position).bottle)
            across, down = scene.camera.project(position)
            assert abs(columns.mean() + 0.5 - across) < 3
            assert abs(rows.mean() + 0.5 - down) < 20  # the hand hides a part of it
            assert len(rows) > 400


def test_a_place_that_is_none_is_refused():
    with HandScene() as scene, pytest.raises(SceneError, match="three finite numbers"):
        scene.look([0.5, np.nan, 0.6])


def test_lossless_video_returns_every_sixth_frame_bit_by_bit(tmp_path, film):
    path = write_video(tmp_path / "hand.avi", film, RATE)
    np.testing.assert_array_equal(read_demonstration(path), film[::6])
    assert [file.name for file in tmp_path.iterdir()] == ["hand.avi"]


def test_a_video_that_cannot_be_written_leaves_no_part_of_itself(tmp_path, film):
    def failing():
        yield film[0]
        raise OSError("no space left on device")

    with pytest.raises(FileError, match="no space left"):
        write_video(tmp_path / "hand.avi", failing(), RATE)
    assert list(tmp_path.iterdir()) == []


def test_a_users_mp4_is_read_with_what_its_compression_left(tmp_path, film):
    path = write_video(tmp_path / "hand.mp4", film, RATE, codec="h264")
    frames = read_demonstration(path)
    assert frames.shape == (11, 240, 240, 3)
    assert np.abs(frames.astype(int) - film[::6]).mean() < 8


def test_a_folder_of_images_is_read_like_a_video(tmp_path, film):
    for index, frame in enumerate(film[:12]):
        cv2.imwrite(str(tmp_path / f"{index:03d}.png"), cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    np.testing.assert_array_equal(read_demonstration(tmp_path, source_rate=30), film[[0, 6]])


def test_frames_are_cropped_in_the_middle_and_resized(tmp_path):
    frames = np.zeros((2, 60, 100, 3), np.uint8)
    frames[:, :, 20:80] = (200, 100, 50)  # the middle square; the borders stay black
    path = write_video(tmp_path / "wide.avi", frames, 5)
    small = read_demonstration(path, size=30)
    assert small.shape == (2, 30, 30, 3)
    np.testing.assert_array_equal(small, np.broadcast_to(np.array([200, 100, 50], np.uint8), small.shape))


def test_uneven_rates_take_the_nearest_frames(tmp_path):
    frames = np.repeat(np.arange(25, dtype=np.uint8)[:, None, None, None] * 10, 3, axis=3) * np.ones((16, 16, 1), "u1")
    path = write_video(tmp_path / "film.avi", frames, 24)
    assert (read_demonstration(path, size=16)[:, 0, 0, 0] / 10).tolist() == [0, 5, 10, 14, 19, 24]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("missing.mp4", None, "there is no video"),
        ("notes.txt", b"hello", "is not a video"),
        ("broken.mp4", b"\x00" * 100, "cannot be decoded"),
    ],
)
def test_a_file_that_is_no_video_is_named_with_the_reason(tmp_path, name, content, message):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(FileError, match=message) as caught:
        read_demonstration(path)
    assert name in str(caught.value)


def test_impossible_requests_are_refused(tmp_path, film):
    path = write_video(tmp_path / "slow.avi", film[:4], 2)
    with pytest.raises(FileError, match="2 frames per second"):
        read_demonstration(path, rate=5)
    with pytest.raises(FileError, match="no PNG"):
        read_demonstration(tmp_path, source_rate=30)
    with pytest.raises(FileError, match="no PNG"):
        read_demonstration(tmp_path)
    cv2.imwrite(str(tmp_path / "0.png"), film[0])
    with pytest.raises(FileError, match="source_rate"):
        read_demonstration(tmp_path)
    with pytest.raises(ProblemError, match="uint8"):
        write_video(tmp_path / "float.avi", film / 255.0, 30)
    with pytest.raises(FileError, match="does the directory exist"):
        write_video(tmp_path / "nowhere" / "film.avi", film, 30)
    for name in ("film.txt", "film"):
        with pytest.raises(FileError, match=rf"{name} has no ending of a film: write it as \.mp4 or \.avi\."):
            write_video(tmp_path / name, film, 30, codec="h264")
        assert not (tmp_path / name).exists()
