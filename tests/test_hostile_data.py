"""Whatever data sets of others hold, they are read, or refused by an exception of the package in one sentence."""

import json
import random
from pathlib import Path

import numpy as np
import pytest

from kpirl_ocp.errors import EpisodeError, FileError
from kpirl_ocp.perception.data.formats.plain import read_csv, read_npz
from kpirl_ocp.perception.data.formats.take import Take

arrow, parquet, h5py = (
    pytest.importorskip("pyarrow"),
    pytest.importorskip("pyarrow.parquet"),
    pytest.importorskip("h5py"),
)

from kpirl_ocp.perception.data.formats.lerobot import read_lerobot  # noqa: E402
from kpirl_ocp.perception.data.formats.robomimic import read_robomimic  # noqa: E402

SEEDS = pytest.mark.parametrize("seed", range(10))
JSON = [
    None,
    True,
    0,
    -1,
    1.5,
    10**30,
    "",
    "a",
    "{x}",
    "{0}",
    [],
    [1],
    [[]],
    {},
    {"a": 1},
    {"dtype": 3},
    {"dtype": "video"},
]
JSON += [float("nan"), float("inf"), "S1000000000", "O", "M8", "../..", "data.parquet", "\0"]
COLUMNS = [[1, 2], [1.5, np.nan], [None, 1], ["a", "b"], [[1], [1, 2]], [[1, 2], [3, 4]], [[1], None], [[[1]], [[2]]]]
COLUMNS += [[b"x", b"y"], [{"bytes": b"x"}, {"bytes": None}], [True, False], [{}, {}], [[], []], [2**62, 2]]
ARRAYS = [np.zeros(0), np.zeros(2), np.zeros((2, 0)), np.array(1.0), np.array([b"a", b"b"]), np.array([1j, 2]), np.inf]
ARRAYS += [np.zeros((2, 2), "i1"), np.zeros((2, 4, 4, 3), "u1"), np.array([True, False]), np.nan, 3, "text"]


def sentence(read):
    """True if it is refused, in one line that names the file; only the package's exceptions are let through."""
    message = ""
    try:
        assert all(isinstance(take, Take) and np.isfinite(take.times).all() for take in read())
    except FileError as error:
        message = str(error)
    assert message.isprintable()
    assert not message or "/" in message or "must" in message, message
    return bool(message)


def spoil(draw, tree):
    """A copy of a tree of dictionaries, of which one entry is something else, or missing."""
    keys, copy = [], json.loads(json.dumps(tree))
    place = copy
    while isinstance(place, dict) and place and (not keys or draw.random() < 0.7):
        parent, key = place, draw.choice(sorted(place))
        keys.append(key)
        place = place[key]
    if draw.random() < 0.2:
        del parent[key]
    else:
        parent[key] = draw.choice(JSON)
    return copy


def data_set(root, info, episodes, columns):
    (root / "meta").mkdir(parents=True)
    (root / "meta/info.json").write_text(json.dumps(info))
    (root / "meta/episodes.jsonl").write_text("\n".join(map(json.dumps, episodes)))
    parquet.write_table(arrow.table(columns), root / "data.parquet")
    return root


INFO = {
    "codebase_version": "v2.1",
    "fps": 10,
    "chunks_size": 1000,
    "features": {"action": {"dtype": "float64", "shape": [2]}, "timestamp": {"dtype": "float32", "shape": [1]}},
    "data_path": "data.parquet",
    "video_path": "{video_key}.mp4",
}
EPISODES = {"0": {"episode_index": 0, "length": 2, "tasks": ["push"]}}
TABLE = {"action": [[1.0, 2.0], [3.0, 4.0]], "timestamp": [0.0, 0.1]}


def test_the_data_set_that_is_spoiled_here_is_read(tmp_path):
    (take,) = read_lerobot(data_set(tmp_path, INFO, EPISODES.values(), TABLE))
    np.testing.assert_array_equal(take["action"], TABLE["action"])
    assert take["action"].dtype == float


@SEEDS
def test_spoiled_metadata_of_lerobot_are_read_or_refused_in_one_sentence(seed, tmp_path):
    draw, count = random.Random(seed), 0
    for number in range(30):
        info, episodes = (spoil(draw, INFO), EPISODES) if number % 2 else (INFO, spoil(draw, EPISODES))
        root = data_set(tmp_path / str(number), info, episodes.values(), TABLE)
        count += sentence(lambda root=root: read_lerobot(root))
    assert count > 10


@SEEDS
def test_spoiled_tables_of_lerobot_are_read_or_refused_in_one_sentence(seed, tmp_path):
    draw, count = random.Random(seed), 0
    for number in range(30):
        columns = TABLE | {draw.choice(sorted(TABLE)): draw.choice(COLUMNS)}
        features = {"action": {"dtype": draw.choice(["float32", "int64", "bool", "image", "string"]), "shape": [2]}}
        try:
            root = data_set(tmp_path / str(number), INFO | {"features": features}, EPISODES.values(), columns)
        except (arrow.ArrowException, NotImplementedError):  # no Parquet file can hold it
            continue
        count += sentence(lambda root=root: read_lerobot(root))
    assert count > 10


@SEEDS
def test_files_with_damaged_bytes_or_without_their_end_are_read_or_refused_in_one_sentence(seed, tmp_path):
    draw = random.Random(seed)
    root = data_set(tmp_path / "set", INFO, EPISODES.values(), TABLE)
    np.savez_compressed(tmp_path / "run.npz", u=np.ones((40, 2)))
    robomimic(tmp_path / "demos.hdf5", {"actions": np.ones((40, 2))})
    for path, read in (
        (root / "data.parquet", lambda: read_lerobot(root)),
        (root / "meta/info.json", lambda: read_lerobot(root)),
        (tmp_path / "run.npz", lambda: [read_npz(tmp_path / "run.npz", rate=1.0)]),
        (tmp_path / "demos.hdf5", lambda: read_robomimic(tmp_path / "demos.hdf5")),
    ):
        whole = path.read_bytes()
        for _ in range(20):
            content = bytearray(whole)
            for _ in range(draw.choice([1, 3, 30])):
                content[draw.randrange(len(content))] = draw.randrange(256)
            path.write_bytes(content[: draw.choice([len(content), draw.randrange(len(content))])])
            sentence(read)
        path.write_bytes(whole)
        assert not sentence(read)


def robomimic(path: Path, demo, name="demo_0", arguments='{"env_kwargs": {"control_freq": 20}}'):
    with h5py.File(path, "w") as file:
        file.create_group("data").attrs["env_args"] = arguments
        group = file["data"].create_group(name)
        for key, value in demo.items():
            group[key] = value
        file["mask/train"], file["mask/odd"] = np.array([name.encode()]), np.ones(2)
    return path


@SEEDS
def test_spoiled_files_of_robomimic_are_read_or_refused_in_one_sentence(seed, tmp_path):
    draw, count, path = random.Random(seed), 0, tmp_path / "demos.hdf5"
    for _ in range(30):
        demo = {key: draw.choice(ARRAYS) for key in draw.sample(["actions", "obs/q", "states", "obs", "dones/a"], 2)}
        if {"obs", "obs/q"} <= set(demo):
            continue
        arguments = json.dumps(spoil(draw, {"env_kwargs": {"control_freq": 20}}))
        robomimic(path, demo, draw.choice(["demo_0", "demo", "0"]), arguments)
        options = {
            "rate": draw.choice([None, 20.0, 0, -1, np.nan, "a", True]),
            "split": draw.choice([None, "odd", "train"]),
        }
        count += sentence(lambda o=options: read_robomimic(path, **o))
    assert count > 10


@SEEDS
def test_any_arrays_in_npz_are_read_or_refused_in_one_sentence(seed, tmp_path):
    draw, count, path = random.Random(seed), 0, tmp_path / "run.npz"
    for _ in range(40):
        np.savez(path, u=np.asarray(draw.choice(ARRAYS)), t=np.asarray(draw.choice(ARRAYS)))
        options = draw.choice([{"time": "t"}, {"rate": draw.choice([1.0, 0, -1, np.inf, "a", True])}, {}])
        count += sentence(lambda o=options: [read_npz(path, **o)])
    assert count > 10


@SEEDS
def test_any_table_in_csv_is_read_or_refused_in_one_sentence(seed, tmp_path):
    draw, count, path = random.Random(seed), 0, tmp_path / "run.csv"
    cells = ["1", "2", "", "a", "nan", "inf", "1e999", '"', '"1"', "\0", "1_0", " 3", "٣", "0x1"]
    for _ in range(40):
        lines = [",".join(draw.choices(cells, k=draw.choice([1, 2, 2, 2, 3]))) for _ in range(draw.randrange(4))]
        path.write_text("\n".join([draw.choice(["t,u", "t,u", "u", "u,u", "", "\ufefft,u"]), *lines]))
        options = draw.choice([{"time": "t"}, {"rate": draw.choice([1.0, 0, -1, np.inf, "a", True])}, {}])
        count += sentence(lambda o=options: [read_csv(path, {"u": draw.choice([["u"], ["u", "t"], []])}, **o)])
    assert count > 10


def test_numbers_are_not_cut_to_whole_ones_and_missing_ones_are_not_filled_in(tmp_path):
    for name, column, reason in (
        ("cut", [1.5, 2.5], "must hold numbers of the type int64, not double"),
        ("missing", [1, None], "must hold numbers of the type int64"),
        ("ragged", [[1], [1, 2]], "lists of one length"),
    ):
        features = {"features": {"action": {"dtype": "int64", "shape": [1]}}}
        root = data_set(tmp_path / name, INFO | features, EPISODES.values(), TABLE | {"action": column})
        with pytest.raises(EpisodeError, match=reason):
            read_lerobot(root)


def test_times_of_a_take_rise():
    with pytest.raises(EpisodeError, match="times do not rise from step 2 on"):
        Take({"u": np.zeros(3)}, [0.0, 0.1, 0.1])
