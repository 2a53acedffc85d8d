"""Videos as phones make them, folders of pictures as people number them, and what is said of files that are none."""

import shlex
import struct
from collections import deque
from fractions import Fraction
from itertools import islice

import numpy as np
import pytest

pytest.importorskip("av")
pytest.importorskip("cv2")

import av
import cv2

from kpirl_ocp.errors import FileError
from kpirl_ocp.perception.data import decoding, video
from kpirl_ocp.perception.data.clips import read_videos
from kpirl_ocp.perception.data.encoding import write_video
from kpirl_ocp.perception.data.video import iterate_frames, read_demonstration, sample_indices, sampled, sampled_frames

HEIGHT, WIDTH = 48, 64
QUARTERS = ((200, 40, 40), (40, 200, 40), (40, 40, 200), (200, 200, 40))  # top left and right, bottom left and right


def picture(height=HEIGHT, width=WIDTH):
    """Four colours, one in each quarter."""
    image = np.zeros((height, width, 3), np.uint8)
    for index, colour in enumerate(QUARTERS):
        rows, columns = divmod(index, 2)
        image[rows * height // 2 : (rows + 1) * height // 2, columns * width // 2 :] = colour
        if not columns:
            image[rows * height // 2 : (rows + 1) * height // 2, : width // 2] = colour
    return image


def corners(image):
    """The colours in the middle of the four quarters."""
    height, width = image.shape[:2]
    return [image[height * a // 4, width * b // 4].astype(int) for a in (1, 3) for b in (1, 3)]


def assert_colours(found, order=(0, 1, 2, 3)):
    np.testing.assert_allclose(found, [QUARTERS[index] for index in order], atol=12)


def grey(level, height=HEIGHT, width=WIDTH):
    return np.full((height, width, 3), level, np.uint8)


def film(path, codec, pixels, frames, *, rate=30, aspect=None, times=None):
    """A video by an encoder that cameras use; times are in frames."""
    with av.open(str(path), "w") as container:
        options = {"x265-params": "log-level=none"} if codec == "libx265" else {}
        stream = container.add_stream(codec, rate=rate, options=options)
        stream.height, stream.width, stream.pix_fmt = *frames[0].shape[:2], pixels
        stream.codec_context.sample_aspect_ratio = aspect or Fraction(1)
        for index, frame in enumerate(frames):
            image = av.VideoFrame.from_ndarray(frame, format="rgb24")
            image.pts = index if times is None else times[index]
            image.time_base = Fraction(1, rate)
            container.mux(stream.encode(image))
        container.mux(stream.encode())
    return path


def turned(path, clockwise):
    """Note in an mp4 file, as a phone does, that the camera was held turned."""
    one = 1 << 16
    matrix = {90: (0, one, 0, -one, 0, 0), 180: (-one, 0, 0, 0, -one, 0), 270: (0, -one, 0, one, 0, 0)}[clockwise]
    content = path.read_bytes()
    start = content.index(b"tkhd") + 44
    path.write_bytes(content[:start] + struct.pack(">9i", *matrix, 0, 0, 1 << 30) + content[start + 36 :])
    return path


@pytest.mark.parametrize(
    ("name", "codec", "pixels"),
    [
        ("h264.mp4", "libx264", "yuv420p"),
        ("h264.m4v", "libx264", "yuv420p"),
        ("h264.3gp", "libx264", "yuv420p"),
        ("hevc.mov", "libx265", "yuv420p"),
        ("hevc-10-bit.mp4", "libx265", "yuv420p10le"),
        ("h264-4-4-4.mkv", "libx264", "yuv444p"),
    ],
)
def test_the_codecs_and_containers_of_phones_are_read(tmp_path, name, codec, pixels):
    path = film(tmp_path / name, codec, pixels, [picture()] * 12)
    found = list(iterate_frames(path))
    np.testing.assert_allclose([time for time, _ in found], np.arange(12) / 30, atol=2e-3)
    assert found[-1][1].shape == (HEIGHT, WIDTH, 3)
    assert_colours(corners(found[-1][1]))


@pytest.mark.parametrize(
    ("clockwise", "shape", "order"),
    [(90, (WIDTH, HEIGHT), (2, 0, 3, 1)), (180, (HEIGHT, WIDTH), (3, 2, 1, 0)), (270, (WIDTH, HEIGHT), (1, 3, 0, 2))],
)
def test_a_phone_held_turned_still_films_upright(tmp_path, clockwise, shape, order):
    path = turned(film(tmp_path / "turned.mp4", "libx264", "yuv420p", [picture()] * 3), clockwise)
    image = next(iterate_frames(path))[1]
    assert image.shape[:2] == shape
    assert_colours(corners(image), order)


@pytest.mark.parametrize(("aspect", "shape"), [(Fraction(4, 3), (48, 85)), (Fraction(3, 4), (64, 64))])
def test_pixels_that_are_not_square_are_made_square(tmp_path, aspect, shape):
    path = film(tmp_path / "dv.mp4", "libx264", "yuv420p", [picture()] * 3, aspect=aspect)
    image = next(iterate_frames(path))[1]
    assert image.shape[:2] == shape
    assert_colours(corners(image))


def test_odd_sizes_are_read_and_written(tmp_path):
    path = film(tmp_path / "odd.mp4", "libx264", "yuv444p", [picture(49, 63)] * 3)
    assert next(iterate_frames(path))[1].shape == (49, 63, 3)
    written = write_video(tmp_path / "out.mp4", np.array([picture(49, 63)] * 3), 5, codec="h264")
    assert next(iterate_frames(written))[1].shape == (48, 62, 3)


def test_a_varying_frame_rate_is_read_by_time(tmp_path):
    times = [0, 3, 6, 9, 12, 13, 14, 15, 16, 17, 18]  # 10 Hz in the dark, then 30 Hz
    frames = [grey(10 * index) for index in range(len(times))]
    path = film(tmp_path / "dark.mp4", "libx264", "yuv420p", frames, times=times)
    found = list(sampled_frames(path, 10))
    np.testing.assert_allclose([time for time, _ in found], np.arange(7) / 10, atol=1e-3)
    np.testing.assert_allclose([image.mean() for _, image in found], [0, 10, 20, 30, 40, 70, 100], atol=4)


def test_sampling_takes_the_nearest_item_and_ends_with_the_last():
    items = [(0.0, "a"), (0.09, "b"), (0.16, "c"), (0.21, "d"), (0.32, "e")]
    assert [item for _, item in sampled(items, 10)] == ["a", "b", "d", "e"]
    assert [item for _, item in sampled(items, 10, start=0.15)] == ["c", "d", "e"]
    assert [item for _, item in sampled([], 10)] == []
    assert sample_indices(25, 24, 5).tolist() == [0, 5, 10, 14, 19, 24]


def test_a_long_film_is_read_in_the_memory_of_its_result(tmp_path):
    """No more than a few frames are alive at a time, however long the film is."""
    alive = []

    class Image(np.ndarray):
        def __del__(self):
            alive.append(-1)

    def frames():
        for index in range(300):
            alive.append(1)
            assert sum(alive) <= 4
            yield index / 30, np.zeros(3).view(Image)

    assert sum(1 for _ in sampled(frames(), 5)) == 50


def test_frames_are_decoded_only_as_far_as_they_are_wanted(tmp_path):
    path = film(tmp_path / "long.mp4", "libx264", "yuv420p", [grey(0)] * 90)
    assert [round(time, 3) for time, _ in sampled_frames(path, 5, start=0.4, end=1.0)] == [0.4, 0.6, 0.8, 1.0]
    with pytest.raises(FileError, match=r"ends after 2\.97 s"):
        list(sampled_frames(path, 5, start=4.0))


def test_a_larger_film_comes_at_the_size_that_is_asked_for(tmp_path):
    path = film(tmp_path / "large.mp4", "libx264", "yuv420p", [picture(120, 200)] * 2)
    assert next(iterate_frames(path, longest=100))[1].shape == (60, 100, 3)
    assert next(iterate_frames(path, longest=500))[1].shape == (120, 200, 3)


# Files that are incomplete, or no videos


def noisy(count):
    rng = np.random.default_rng(0)
    return [rng.integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8) for _ in range(count)]


@pytest.mark.parametrize("share", [0.5, 0.75])
@pytest.mark.parametrize("name", ["data.avi", "phone.mkv", "web.mp4", "phone.mov"])
def test_half_a_file_is_never_a_shorter_film(tmp_path, name, share):
    frames = noisy(60)
    path = tmp_path / name
    if name.endswith(".avi"):
        write_video(path, np.array(frames), 30)
    elif name == "web.mp4":
        with av.open(str(path), "w", options={"movflags": "faststart"}) as container:
            stream = container.add_stream("libx264", rate=30)
            stream.height, stream.width, stream.pix_fmt = HEIGHT, WIDTH, "yuv420p"
            for frame in frames:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
            container.mux(stream.encode())
    else:
        film(path, "libx264", "yuv420p", frames)
    whole = path.read_bytes()
    for cut in range(int(share * len(whole)), int(share * len(whole)) + 3000, 500):
        path.write_bytes(whole[:cut])
        with pytest.raises(FileError, match="complete") as caught:
            read_demonstration(path)
        assert name in str(caught.value)


def test_what_comes_before_the_damage_can_be_used(tmp_path):
    path = write_video(tmp_path / "data.avi", np.array(noisy(60)), 30)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert len(list(sampled_frames(path, 5, end=0.6))) == 4


def test_a_codec_that_cannot_be_decoded_is_named_with_the_command_that_converts_it(tmp_path):
    path = film(tmp_path / "very strange.mp4", "libx264", "yuv420p", [picture()] * 3)
    path.write_bytes(path.read_bytes().replace(b"avc1", b"xyz9"))
    with pytest.raises(FileError, match=r"codec .xyz9. cannot be decoded here\. Convert it with\n") as caught:
        next(iterate_frames(path))
    command = shlex.split(str(caught.value).splitlines()[1])  # a line that a shell takes as it is
    assert (command[0], command[2], command[-1]) == ("ffmpeg", str(path), str(tmp_path / "very strange-h264.mp4"))


def test_times_that_fall_are_refused_with_the_command_that_mends_them(tmp_path):
    """An .avi stores the times at which frames are decoded, which are others where frames depend on later ones."""
    path = film(tmp_path / "old.avi", "libx264", "yuv420p", [np.roll(picture(), 2 * index, 1) for index in range(30)])
    with pytest.raises(FileError, match=r"the times of its frames do not rise\. Convert it with\n.*ffmpeg -i"):
        list(iterate_frames(path))


def test_sound_alone_is_no_video(tmp_path):
    path = tmp_path / "song.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=8000)
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        sound.rate = 8000
        container.mux(stream.encode(sound))
        container.mux(stream.encode())
    with pytest.raises(FileError, match="no video"):
        next(iterate_frames(path))


# Folders


def test_pictures_come_in_the_order_in_which_people_number_them(tmp_path):
    for index, suffix in enumerate(["png", "jpg", "JPEG"] * 4):
        cv2.imwrite(str(tmp_path / f"frame{index}.{suffix}"), grey(20 * index))
    found = list(iterate_frames(tmp_path, source_rate=10))
    np.testing.assert_allclose([image.mean() for _, image in found], 20 * np.arange(12), atol=2)
    np.testing.assert_allclose([time for time, _ in found], np.arange(12) / 10)


def test_hidden_files_beside_pictures_and_videos_are_none(tmp_path):
    """Such as macOS writes next to every file on a stick."""
    cv2.imwrite(str(tmp_path / "1.png"), picture())
    film(tmp_path / "1.mp4", "libx264", "yuv420p", [picture()] * 7)
    (tmp_path / "._1.png").write_bytes(b"\0\5\x16\7")
    (tmp_path / "._1.mp4").write_bytes(b"\0\5\x16\7")
    assert len(list(iterate_frames(tmp_path, source_rate=10))) == 1
    assert len(read_videos([tmp_path])) == 1


def test_a_file_that_is_no_picture_is_named_in_plain_words(tmp_path):
    (tmp_path / "1.png").write_bytes(b"no picture")
    with pytest.raises(FileError, match=r"1\.png cannot be read as an image: it is no PNG or JPEG, whatever its name"):
        list(iterate_frames(tmp_path, source_rate=10))


def test_pictures_of_several_sizes_are_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "1.png"), picture())
    cv2.imwrite(str(tmp_path / "2.png"), picture(20, 20))
    with pytest.raises(FileError, match=r"differ in size: 2.png"):
        list(iterate_frames(tmp_path, source_rate=10))


def test_a_directory_of_videos_of_any_kind_is_read_in_natural_order(tmp_path):
    for index in (10, 2, 1):
        film(tmp_path / f"clip{index}.{'m4v' if index == 2 else 'mov'}", "libx264", "yuv420p", [grey(20 * index)] * 7)
    assert [round(clip.mean() / 20) for clip in read_videos([tmp_path])] == [1, 2, 10]
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileError, match="holds no video"):
        read_videos([tmp_path / "empty"])


def test_a_video_is_not_told_its_frame_rate(tmp_path):
    path = film(tmp_path / "clip.mp4", "libx264", "yuv420p", [picture()] * 3)
    with pytest.raises(FileError, match="times of its own"):
        read_demonstration(path, source_rate=30)


# Sizes, before memory is taken


def gif(width, height):
    """One frame of one pixel on a canvas of any size."""
    canvas = b"GIF89a" + struct.pack("<2H", width, height) + b"\x80\0\0" + b"\0\0\0\xff\xff\xff"
    return canvas + b"\x2c" + struct.pack("<4H", 0, 0, 1, 1) + b"\0\x02\x02\x44\x01\0" + b"\x3b"


def test_a_film_whose_header_announces_huge_frames_is_refused(tmp_path):
    path = tmp_path / "huge.gif"
    path.write_bytes(gif(20_000, 20_000))
    with pytest.raises(FileError, match="more than 89 million pixels"):
        next(iterate_frames(path))
    path.write_bytes(gif(20, 10))
    assert next(iterate_frames(path))[1].shape == (10, 20, 3)


def test_frames_that_are_too_large_once_their_pixels_are_square_are_refused_by_their_header(tmp_path, monkeypatch):
    path = film(tmp_path / "dv.mp4", "libx264", "yuv420p", [picture()] * 3, aspect=Fraction(4, 3))
    monkeypatch.setattr(decoding, "_MOST_PIXELS", 85 * HEIGHT)
    assert next(iterate_frames(path))[1].shape == (HEIGHT, 85, 3)
    monkeypatch.setattr(decoding, "_MOST_PIXELS", 85 * HEIGHT - 1)
    with pytest.raises(FileError, match="85 x 48 pixels; at most"):
        next(iterate_frames(path))


def test_a_pause_of_years_between_two_frames_is_not_filled(tmp_path):
    path = film(tmp_path / "pause.mkv", "libx264", "yuv420p", [grey(10), grey(20)], times=[0, 30 * 10**7])
    frames = sampled_frames(path, 5.0)
    assert len(list(islice(frames, 1000))) == 1000
    with pytest.raises(FileError, match="5 cannot be taken from it"):
        deque(islice(frames, 1000))


def test_a_film_that_does_not_fit_into_memory_is_refused_while_it_is_read(tmp_path, monkeypatch):
    path = film(tmp_path / "long.mp4", "libx264", "yuv420p", [picture()] * 60)
    assert read_demonstration(path, rate=30, size=16).shape == (60, 16, 16, 3)
    monkeypatch.setattr(video, "LARGEST", 40 * 16 * 16 * 3)
    with pytest.raises(FileError, match="too long"):
        read_demonstration(path, rate=30, size=16)
