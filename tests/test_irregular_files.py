"""A FIFO, device, socket or directory where a file is expected is refused in a sentence, and nobody waits for it."""

import os
import signal
import socket
import sys
from pathlib import Path

import pytest

from kpirl_ocp.cli.main import COMMANDS, options_of, run
from kpirl_ocp.cli.parser import build_parser, read_config
from kpirl_ocp.cli.values import existing_file
from kpirl_ocp.episodes import Episode, read_episode, read_episodes
from kpirl_ocp.errors import KpirlError
from kpirl_ocp.irl.cases.cost_files import LearnedCost
from kpirl_ocp.irl.learning.checkpoint import Checkpoint
from kpirl_ocp.model_cards import DETECTOR, read_model
from kpirl_ocp.ocp.export import manifest

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))


def of(module, function, *others):
    """A reader of a module whose packages may not be installed."""
    return lambda path: getattr(pytest.importorskip(module, exc_type=ImportError), function)(path, *others)


def of_weights(path):
    path.with_name("card.json").write_text(f'{{"kind": "{DETECTOR}", "version": 1}}')
    read_model(path.with_name("card.json"), DETECTOR)


def of_pictures(path):
    list(of("kpirl_ocp.perception.data.pictures", "iterate_pictures")(path.parent))


def of_detector_training(path):
    model = pytest.importorskip("torch").nn.Linear(1, 1)
    of("kpirl_ocp.perception.detector.checkpoint", "Checkpoint", {})(path).load(model, None, ())


def of_tables(path):
    pytest.importorskip("pyarrow")
    of("kpirl_ocp.perception.data.formats.lerobot", "_DataSet")(path.parent)._table(path)


FORMATS = "kpirl_ocp.perception.data.formats"
READERS = {  # name of a file: its reader
    "config.yaml": read_config,
    "meta.json": lambda path: read_episodes(path.parent, Episode),
    "episode_000.npz": lambda path: read_episode(path, Episode),
    "cost.json": LearnedCost.read,
    "detector.json": lambda path: read_model(path, DETECTOR),
    "card.safetensors": of_weights,
    "manifest.json": lambda path: manifest.read(path.parent),
    "learning.npz": lambda path: Checkpoint(path, "").load(),
    "network.onnx": of("kpirl_ocp.ocp.models.onnx.load", "load_onnx"),
    "job.npz": of("reproduction.sweep", "_read"),
    "recording.npz": of("kpirl_ocp.perception.data.recordings", "read_arm_film"),
    "picture.png": of_pictures,
    "checkpoint.safetensors": of_detector_training,
    "take.npz": of(f"{FORMATS}.plain", "read_npz"),
    "take.csv": of(f"{FORMATS}.plain", "read_csv", {"action": ["u"]}),
    "take.hdf5": of(f"{FORMATS}.robomimic", "read_robomimic"),
    "data.parquet": of_tables,
}
OF_THEIR_OWN = {  # refused as if nothing were there
    "own.urdf": of("kpirl_ocp.ocp.models.robot_files", "read_urdf"),
    "own.py": lambda path: of("kpirl_ocp.irl.cases.own", "load_own")(f"{path}:f"),
    "tracks.npz": of("kpirl_ocp.perception.tracking.tracks", "read_tracks"),
    "film.mp4": lambda path: next(of("kpirl_ocp.perception.data.decoding", "decode")(path)),
}
KINDS = {
    "a FIFO": os.mkfifo,
    "a directory": os.mkdir,
    "a socket": lambda path: socket.socket(socket.AF_UNIX).bind(path.name),  # a path of at most 108 characters
    "a device": lambda path: path.symlink_to("/dev/zero"),
}


def ring(*_):
    raise TimeoutError("somebody waits")


@pytest.fixture(autouse=True)
def promptly():
    """Who waits fails, instead of never coming to an end."""
    former = signal.signal(signal.SIGALRM, ring)
    signal.alarm(60)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, former)


@pytest.mark.parametrize("name", READERS | OF_THEIR_OWN)
@pytest.mark.parametrize("kind", KINDS)
def test_whoever_reads_a_file_says_that_it_is_none(kind, name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    KINDS[kind](tmp_path / name)
    expected = rf"there (is|are) no .*{name}" if name in OF_THEIR_OWN else rf"{name}.*\bit is {kind}, and not a file"
    with pytest.raises(KpirlError, match=expected):
        (READERS | OF_THEIR_OWN)[name](tmp_path / name)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("command", COMMANDS)
def test_every_option_that_takes_a_file_refuses_what_is_none(command, kind, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    KINDS[kind](Path("there"))
    options = build_parser(command, "", options_of(command).add_options)._actions
    files = [option.option_strings[-1] for option in options if option.type is existing_file]
    assert "--config" in files
    for name in files:
        assert run([command, name, "there"]) == 2
        assert capsys.readouterr().err == f"error: {name}: 'there' cannot be read: it is {kind}, and not a file.\n"
