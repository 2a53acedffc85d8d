"""Options of `kpirl learn-video` are checked before the film is opened: here there is none, and nothing says so."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("av")
pytest.importorskip("cv2")
pytest.importorskip("pybullet")
pytest.importorskip("torch")

import av

from kpirl_ocp.assets import shipped_model
from kpirl_ocp.cli.main import run
from kpirl_ocp.irl.cases.cost_files import ArmSetting, LearnedCost
from kpirl_ocp.irl.visual.learning import CONVERGED
from kpirl_ocp.irl.visual.planning_costs import PlanningCost, write_planning_cost
from kpirl_ocp.ocp.models.dynamics_files import load_dynamics
from kpirl_ocp.ocp.models.keypoint_costs import KeypointCost, Weighted
from kpirl_ocp.ocp.models.pinhole import Pinhole
from kpirl_ocp.ocp.solvers.riccati import Riccati
from kpirl_ocp.perception.data.encoding import write_video
from kpirl_ocp.perception.hands import landmarks

DETECTOR = f"--detector {shipped_model('detector')}"
MODELS = f"{DETECTOR} --dynamics {shipped_model('placing')}"
IN_SPACE = LearnedCost(KeypointCost(Weighted()), np.ones(6), 5, Riccati())
CAMERA = Pinhole(np.diag([300.0, 300.0, 1.0]), np.eye(3), np.zeros(3))
ON_FILM = replace(IN_SPACE, setting=ArmSetting(camera=CAMERA), displacement=np.ones(6))


@pytest.fixture
def refused(tmp_path, capsys):
    """The sentence with which options for a film that does not exist are refused."""

    def sentence(words):
        assert run(["learn-video", "no_film.mp4", *words.split(), "--out", str(tmp_path / "out")]) == 2
        return capsys.readouterr().err

    return sentence


def test_right_options_reach_the_film(refused):
    assert "no_film.mp4" in refused("--robot panda --flange panda_hand")
    assert "no_film.mp4" in refused(MODELS)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (f"--dynamics {shipped_model('placing')}", "--dynamics: needs --detector"),
        ("--start 3 --end 1", "--end: must be after --start, 3 s, got 1 s"),
        (f"--recording {__file__}", "--recording: needs --dynamics"),
        (f"{MODELS} --robot ur5", "--robot: not with --dynamics"),
        (f"{MODELS} --flange hand", "--flange: not with --dynamics"),
        (f"{MODELS} --object-size 0.1", "--object-size: not with --dynamics"),
    ],
)
def test_options_that_do_not_go_together_are_named(words, message, refused):
    assert message in refused(words)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--robot pnada", "--robot: example-robot-data has no robot 'pnada': did you mean 'panda'?"),
        ("--robot nowhere.urdf", "--robot: there is no URDF file"),
        ("--flange hnad", "--flange: the robot 'lbr_iiwa' has no link 'hnad'; its links are: lbr_iiwa_link_0"),
        ("--robot panda --flange lbr_iiwa_link_7", "has no link 'lbr_iiwa_link_7'"),
        (
            f"--cost {__file__}",
            f"--cost: {__file__.removesuffix('test_video_options.py')}test_video_options.py is not a learned cost",
        ),
        (f"--tracks {__file__}", f"--tracks: {__file__}: tracks come as .npz or .csv."),
        (f"--detector {__file__}", f"--detector: {__file__}"),
        (f"{DETECTOR} --dynamics {__file__}", f"--dynamics: {__file__}"),
        (f"{MODELS} --cost {__file__}", f"--cost: {__file__} is not a cost over detected keypoints"),
        (f"{MODELS} --recording {__file__}", f"--recording: {__file__}"),
    ],
)
def test_arms_links_and_files_are_looked_at_first(words, message, refused):
    assert message in refused(words)


TRACKS = {  # text of a .csv, sentence
    "": "cannot be read as CSV: it is empty.",
    "point,x,y\n1,2,3\n": "has no column frame; it has point, x, y. It needs point, x, y, and time or frame; "
    "visibility if it is known.",
    "point,x,y,time\n1,2,3,0\n2,2,3,0\n1,3,3,0.0\n": "line 2: this point has another place at the same time, "
    "further down.",
    "point,x,y,frame\n1,2,3,0\n1,3,3,1\n": "has no times: say the frame rate of the film (--source-rate).",
    "point,x,y,time\n1,2,3,0\n": "tracks must be (n, K, 2) with n = 1 times of at least 2, got (1, 1, 2).",
    "point,x,y,time\n1,two,3,0\n": "line 2, x: expected a number, got 'two'.",
    "point,x,y,time\n1,nan,3,0\n1,3,3,1\n": "tracks hold NaN or infinity where the keypoint is visible.",
}


@pytest.mark.parametrize("text", TRACKS)
def test_wrong_tracks_are_refused_first(text, refused, tmp_path):
    (tmp_path / "tracks.csv").write_text(text)
    sentence = refused(f"--tracks {tmp_path / 'tracks.csv'}")
    assert sentence.startswith(f"error: --tracks: {tmp_path / 'tracks.csv'}")
    assert TRACKS[text] in sentence


def test_right_tracks_reach_the_film(refused, tmp_path):
    (tmp_path / "tracks.csv").write_text("point,x,y,frame\n1,2,3,0\n1,3,3,1\n")
    assert "no_film.mp4" in refused(f"--tracks {tmp_path / 'tracks.csv'} --source-rate 30 --scale 1")


def test_tracks_do_not_tell_the_size_of_the_object(refused, tmp_path):
    (tmp_path / "tracks.csv").write_text("point,x,y,time\n1,2,3,0\n1,3,3,1\n")
    tracks = f"--tracks {tmp_path / 'tracks.csv'}"
    assert "error: --tracks: needs --scale, the pixels of the arm's camera per pixel of the film" in refused(tracks)
    assert "--object-size: --tracks does not say how many pixels long" in refused(f"{tracks} --object-size 0.2")
    assert "error: --detector: needs --scale" in refused(DETECTOR)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--box 0,0,300,20", "--box: the box 0,0,300,20 is not inside the image of 240 x 180 pixels: give its left"),
        ("--box 20,0,10,20", "--box: the box 20,0,10,20 is not inside"),
        ("--points 10,10 10,-1", "--points: a clicked point is outside the image of 240 x 180 pixels: give x and y"),
        ("--end 0.4", "--end: {film} ends after 0.30 s, 0.4 s is later; give less, or leave --end out"),
        ("--start 2", "--start: {film} ends after 0.30 s, 2 s is later; give less, or leave --start out"),
        ("--start 0.2 --end 5", "--end: {film} ends after 0.30 s, 5 s is later"),
        ("--end 0.34", "has 3 frames from 0 s to 0.34 s: that shows no motion."),  # as a player rounds 0.3
    ],
)
def test_places_and_times_outside_the_film_are_refused_before_it_is_watched(words, message, tmp_path, capsys):
    film = write_video(tmp_path / "film.mp4", np.zeros((3, 180, 240, 3), np.uint8), 10)  # too short for a motion
    assert run(["learn-video", str(film), *words.split(), "--out", str(tmp_path)]) == 2
    assert message.format(film=film) in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "words", "message"),
    [
        ("empty", "", "the folder {path} holds no PNG or JPEG pictures: give one that does, or a video."),
        ("empty", "--source-rate 10", "the folder {path} holds no PNG or JPEG pictures"),
        ("one.png", "", "{path} is one picture, which shows no motion: give a video, or a folder of pictures."),
        ("sound.mp3", "", "{path} is not a video: expected one of .mp4"),
        ("sound.mp4", "", "{path} holds no video, only sound or subtitles."),
        ("empty", "--source-rate 0", "--source-rate: expected a finite number above 0, got '0'"),
    ],
)
def test_what_is_no_film_is_refused(name, words, message, tmp_path, capsys):
    path = tmp_path / name
    if name == "empty":
        path.mkdir()
    elif name == "sound.mp4":
        with av.open(str(path), "w") as container:
            stream = container.add_stream("aac", rate=44100, layout="mono")
            silence = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
            silence.sample_rate = 44100
            container.mux([*stream.encode(silence), *stream.encode()])
    else:
        path.write_bytes(b"\0" * 100)
    assert run(["learn-video", str(path), *words.split(), "--out", str(tmp_path / "out")]) == 2
    assert message.format(path=path) in capsys.readouterr().err


def npz(**arrays):
    return {"tracks": np.full((3, 4, 2), 20.0), "size": np.array([240, 180]), **arrays}


@pytest.mark.parametrize(
    ("tracks", "words", "message"),
    [
        (None, "--source-rate 10", "--source-rate: {film} has its own times; the option is for pictures and --tracks"),
        (
            npz(),
            "--source-rate 20",
            "--source-rate: {film} has 10 frames a second, so 3 frames of tracks in it have no 20; give",
        ),
        (
            npz(times=np.arange(3) / 10),
            "--source-rate 5",
            "has times of its own, at 10 frames a second",
        ),
        (
            npz(size=np.array([480, 360])),
            "--source-rate 10",
            "--tracks: the tracks are for frames of 480 x 360",
        ),
        (
            {"tracks": np.full((3, 4, 2), 400.0)},
            "--source-rate 10",
            "all keypoints outside the frames, around 400,400",
        ),
        (npz(), "--source-rate 10", "has 3 frames from 0 s to its end: that shows no motion."),
        (npz(), "--source-rate 10.1", "has 3 frames"),
        (npz(tracks=np.full((5, 4, 2), 20.0)), "--source-rate 20", "has 3 frames"),  # interpolated
        (npz(), "--source-rate 5", "has 3 frames"),
        (npz(times=np.arange(3) / 10), "--source-rate 10", "has 3 frames"),
        (npz(times=np.arange(3) / 10), "", "has 3 frames"),
    ],
)
def test_numbers_that_contradict_the_film_are_refused_before_it_is_watched(tracks, words, message, tmp_path, capsys):
    film = write_video(tmp_path / "film.mp4", np.zeros((3, 180, 240, 3), np.uint8), 10)
    path = tmp_path / "tracks.npz"
    if tracks is not None:
        np.savez(path, **tracks)
        words += f" --tracks {path} --scale 1"
    assert run(["learn-video", str(film), *words.split(), "--out", str(tmp_path)]) == 2
    assert message.format(film=film) in capsys.readouterr().err


@pytest.mark.parametrize(
    ("cost", "words", "message"),
    [
        (IN_SPACE, "--steps 5", "is for keypoints in space; a film needs keypoints in a camera's image"),
        (ON_FILM, "--steps 8", "has T = 5, --steps says 8"),
        (ON_FILM, "--steps 5 --robot panda", "is for the robot 'iiwa', not 'panda'"),
        (ON_FILM, "--steps 5", "no_film.mp4"),
    ],
)
def test_a_cost_for_something_else_is_refused_first(cost, words, message, refused, tmp_path):
    cost.write(tmp_path / "cost.json")
    assert message in refused(f"--cost {tmp_path / 'cost.json'} {words}")


def test_a_cost_over_detected_keypoints_for_other_steps_is_refused_first(refused, tmp_path):
    cost = PlanningCost(np.ones((3, 8)), np.ones(3), CONVERGED)
    path = write_planning_cost(tmp_path / "cost.json", cost, load_dynamics(shipped_model("placing")))
    assert "has T = 3, --steps says 4" in refused(f"{MODELS} --cost {path} --steps 4")
    assert "no_film.mp4" in refused(f"{MODELS} --cost {path} --steps 3")


def test_the_extra_for_hands_is_asked_for_first(refused, monkeypatch):
    monkeypatch.setattr(landmarks, "Interpreter", None)
    landmarks._interpreter.cache_clear()
    assert "kpirl-ocp[hands]" in refused("--hand")
