"""Files that take far more memory than they have bytes are refused before the memory is taken; nothing is unpickled."""

import ast
import json
import re
import resource
import struct
import sys
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest

from kpirl_ocp.cli.parser import read_config
from kpirl_ocp.episodes import Episode, read_episode
from kpirl_ocp.errors import FileError, KpirlError
from kpirl_ocp.irl.cases.cost_files import LearnedCost
from kpirl_ocp.irl.learning.checkpoint import Checkpoint
from kpirl_ocp.sizes import read_json

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "scripts"))
LIMIT = 2**27  # [bytes], instead of 2 GiB, so that bombs are made quickly
MANY = 3 * LIMIT // 8  # numbers of 8 bytes


@pytest.fixture(autouse=True)
def limit(monkeypatch):
    monkeypatch.setattr("kpirl_ocp.sizes.LARGEST", LIMIT)


@pytest.fixture
def frugal():
    """The peak of the process's memory rises by less than 100 MB."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # KiB


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    """384 MiB of zeros in 2 MB."""
    path, piece = tmp_path_factory.mktemp("bomb") / "bomb.npz", bytes(2**24)
    bomb = zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1)
    with bomb, bomb.open("points.npy", "w", force_zip64=True) as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": (MANY,)})
        for _ in range(24):
            file.write(piece)
    return path


def of_an_episode(path):
    return read_episode(path, Episode)


def of_a_take(path):
    return pytest.importorskip("kpirl_ocp.perception.data.formats.plain").read_npz(path, rate=10.0)


def of_tracks(path):
    return pytest.importorskip("kpirl_ocp.perception.tracking.tracks").read_tracks(path)


def of_a_sweep(path):
    from reproduction import sweep

    return sweep._read(path)


def of_learning(path):
    return Checkpoint(path, "").load()


@pytest.mark.parametrize("read", [of_an_episode, of_a_take, of_tracks, of_a_sweep, of_learning])
def test_archives_of_gigabytes_are_refused(read, archive, frugal):
    with pytest.raises(FileError, match=r"unpacks to 0\.4 GiB; at most 0\.125 GiB"):
        read(archive)


def test_a_damaged_result_of_a_sweep_is_named(tmp_path):
    (tmp_path / "a.npz").write_bytes(b"PK\x03\x04 half")
    with pytest.raises(FileError, match=r"a\.npz is no finished result .*: remove it"):
        of_a_sweep(tmp_path / "a.npz")


def data_set(tmp_path, table, **options):
    """A LeRobot data set with one table."""
    parquet = pytest.importorskip("pyarrow.parquet")
    features = {name: {"dtype": "int64", "shape": [1]} for name in ("action", "timestamp")}
    info = {"codebase_version": "v2.1", "fps": 10, "features": features, "data_path": "data.parquet"}
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta/info.json").write_text(json.dumps(info))
    (tmp_path / "meta/episodes.jsonl").write_text('{"episode_index": 0, "length": 1}')
    with parquet.ParquetWriter(tmp_path / "data.parquet", table.schema, **options) as writer:
        yield writer


def test_a_parquet_table_of_very_many_rows_is_refused(tmp_path, frugal):
    arrow = pytest.importorskip("pyarrow")
    lerobot = pytest.importorskip("kpirl_ocp.perception.data.formats.lerobot")
    piece = arrow.table({"action": np.zeros(2**22, np.int8), "timestamp": np.zeros(2**22, np.int8)})
    for writer in data_set(tmp_path, piece):
        for _ in range(3):
            writer.write_table(piece)
    assert (tmp_path / "data.parquet").stat().st_size < 2**20
    with pytest.raises(FileError, match=r"data\.parquet cannot be read as Parquet: it unpacks to 0\.2 GiB"):
        lerobot.read_lerobot(tmp_path)


def test_a_parquet_table_that_repeats_one_large_value_is_refused(tmp_path):
    """Its metadata announce one value: it is read until it is too large."""
    arrow = pytest.importorskip("pyarrow")
    lerobot = pytest.importorskip("kpirl_ocp.perception.data.formats.lerobot")
    cells = arrow.DictionaryArray.from_arrays(np.zeros(1000, np.int32), ["x" * 2**18])
    table = arrow.table({"action": cells, "timestamp": np.zeros(1000)})
    for writer in data_set(tmp_path, table):
        writer.write_table(table)
    assert (tmp_path / "data.parquet").stat().st_size < 2**20
    with pytest.raises(FileError, match="cannot be read as Parquet: it unpacks to"):
        lerobot.read_lerobot(tmp_path)


def test_an_hdf5_file_that_announces_gigabytes_is_refused(tmp_path, frugal):
    h5py = pytest.importorskip("h5py")
    robomimic = pytest.importorskip("kpirl_ocp.perception.data.formats.robomimic")
    with h5py.File(tmp_path / "bomb.hdf5", "w") as file:
        file.create_dataset("data/demo_0/actions", (MANY, 1), "f8", chunks=(2**16, 1), compression="gzip")
    with pytest.raises(FileError, match=r"bomb\.hdf5 cannot be read: it unpacks to 0\.4 GiB"):
        robomimic.read_robomimic(tmp_path / "bomb.hdf5", rate=20.0)


@pytest.mark.parametrize("link", ["soft", "hard"])
def test_an_hdf5_file_that_links_one_array_many_times_is_refused(tmp_path, link):
    """Neither kind of link is counted when the file's arrays are visited."""
    h5py = pytest.importorskip("h5py")
    robomimic = pytest.importorskip("kpirl_ocp.perception.data.formats.robomimic")
    with h5py.File(tmp_path / "bomb.hdf5", "w") as file:
        file.create_dataset("one", (2**18, 1), "f8", chunks=(2**16, 1), compression="gzip")
        for number in range(80):
            file[f"data/demo_{number}/actions"] = h5py.SoftLink("/one") if link == "soft" else file["one"]
    with pytest.raises(FileError, match=r"bomb\.hdf5 cannot be read: it unpacks to 0\.1 GiB"):
        robomimic.read_robomimic(tmp_path / "bomb.hdf5", rate=20.0)


def test_a_csv_file_of_very_many_cells_is_refused(tmp_path, frugal):
    plain = pytest.importorskip("kpirl_ocp.perception.data.formats.plain")
    (tmp_path / "run.csv").write_text("u\n" + "1," * 2**22)
    with pytest.raises(FileError, match=r"run\.csv cannot be read as CSV: it unpacks to"):
        plain.read_csv(tmp_path / "run.csv", {"u": ["u"]}, rate=1.0)


def png(width, height):
    """A whole PNG file of black pixels."""

    def chunk(kind, content):
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    packer, row = zlib.compressobj(1), bytes((width + 7) // 8 + 1)
    rows = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()
    header = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def test_a_picture_of_very_many_pixels_is_refused(tmp_path, frugal):
    """Of one bit each: a decoder takes 3 bytes for every one."""
    pictures = pytest.importorskip("kpirl_ocp.perception.data.pictures")
    for width, height in ((13_000, 13_000), (60_000, 20_000)):
        (tmp_path / "frame.png").write_bytes(png(width, height))
        with pytest.raises(FileError, match=r"frame\.png cannot be read as an image: Image size .* exceeds limit"):
            next(pictures.iterate_pictures(tmp_path))
    (tmp_path / "frame.png").write_bytes(png(64, 48)[:-40])
    with pytest.raises(FileError, match=r"frame\.png cannot be read as an image"):
        next(pictures.iterate_pictures(tmp_path))
    (tmp_path / "frame.png").write_bytes(png(64, 48))
    assert next(pictures.iterate_pictures(tmp_path)).shape == (48, 64, 3)


def test_tracks_whose_table_would_be_far_larger_than_the_file_are_refused(tmp_path, frugal):
    """Every line has a time and a point of its own: lines squared."""
    tracks = pytest.importorskip("kpirl_ocp.perception.tracking.tracks")
    lines = [f"{i},{i},1,1" for i in range(20_000)]
    (tmp_path / "tracks.csv").write_text("\n".join(["time,point,x,y", *lines]))
    with pytest.raises(FileError, match="unpacks to"):
        tracks.read_tracks(tmp_path / "tracks.csv")


def test_json_that_is_nested_deeply_or_very_long_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "cost.json"
    path.write_text("[" * 200_000)
    with pytest.raises(FileError, match="is not a learned cost"):
        LearnedCost.read(path)
    monkeypatch.setattr("kpirl_ocp.sizes._LARGEST_TEXT", 100)
    path.write_text("[" + " " * 100 + "]")
    with pytest.raises(ValueError, match="more than"):
        read_json(path)


def test_yaml_whose_aliases_would_unfold_to_gigabytes_is_refused(tmp_path, frugal):
    """Nine aliases, nine times over."""
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 10)]
    (tmp_path / "bomb.yaml").write_text("\n".join(lines))
    with pytest.raises(KpirlError, match="not nested"):
        read_config(tmp_path / "bomb.yaml")
    (tmp_path / "deep.yaml").write_text("[" * 10_000)
    with pytest.raises(KpirlError, match=r"deep\.yaml is not a YAML file"):
        read_config(tmp_path / "deep.yaml")


def test_nothing_is_unpickled():
    """No source file calls a reader of pickles, or switches numpy's or torch's on."""
    forbidden = re.compile(
        r"pickle\.loads?|allow_pickle=True|weights_only=False|joblib\.load|read_pickle|yaml\.(unsafe_)?load$"
    )
    calls = 0
    for path in [*ROOT.glob("kpirl_ocp/**/*.py"), *ROOT.glob("scripts/**/*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call):
                text = ast.unparse(node.func)
                words = " ".join(f"{k.arg}={ast.unparse(k.value)}" for k in node.keywords)
                calls += "allow_pickle=False" in words
                assert not forbidden.search(text), f"{path}: {text}"
                assert not forbidden.search(words), f"{path}: {words}"
                assert text != "torch.load", path
                assert text != "np.load" or "allow_pickle=False" in words, path
    assert calls >= 8
