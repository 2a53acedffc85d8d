"""Data sets of others: what is written comes back, what others write is read, and what is amiss is named."""

import json

import numpy as np
import pytest

from kpirl_ocp.errors import EpisodeError, FileError
from kpirl_ocp.irl.cases.tasks import demonstrate
from kpirl_ocp.ocp.models import Robot

pytest.importorskip("cv2")
import cv2

from kpirl_ocp.perception.data.encoding import write_video
from kpirl_ocp.perception.data.formats.lerobot import read_lerobot
from kpirl_ocp.perception.data.formats.lerobot_writer import write_lerobot
from kpirl_ocp.perception.data.formats.plain import read_csv, read_npz
from kpirl_ocp.perception.data.formats.robomimic import read_robomimic
from kpirl_ocp.perception.data.formats.take import Take, episode_of_take, take_of_episode
from kpirl_ocp.perception.tracking.tracks import read_tracks

pa, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
h5py = pytest.importorskip("h5py")
RNG = np.random.default_rng(0)
RATE = 10.0
CAMERA = "observation.images.top"


def film(count, brightness):
    """A bright square that moves over a smooth background."""
    y, x = np.mgrid[:48, :64]
    frames = np.repeat(np.array([x + y, 2 * x, 2 * y], np.uint8).transpose(1, 2, 0)[None], count, axis=0)
    for t in range(count):
        frames[t, 10:26, 2 + 3 * t : 18 + 3 * t] = brightness
    return frames


def take(count=6, brightness=200, task="place the bottle", **arrays):
    arrays = {
        "observation.state": RNG.normal(size=(count, 7)).astype(np.float32),
        "action": RNG.normal(size=(count, 7)),
        "gripper": RNG.normal(size=count).astype(np.float32),
        "next.done": np.arange(count) == count - 1,
        "stage": np.arange(count) // 2,
    } | arrays
    return Take(arrays, np.arange(count) / RATE, {CAMERA: film(count, brightness)}, task)


def check_same(found, expected, copies=1):
    assert found.task == expected.task
    assert found.arrays.keys() == expected.arrays.keys()
    np.testing.assert_allclose(found.times, expected.times, atol=1e-6)
    for name, array in expected.arrays.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)
    for name in expected.videos:
        difference = np.abs(found.frames(name).astype(float) - expected.frames(name))
        assert difference.mean() < 2.5 * copies  # grey levels; H.264 is not lossless, and narrow films vary a little


def test_a_lerobot_data_set_comes_back_as_it_was_written(tmp_path):
    takes = [take(6), take(9, 90, "pour"), take(4, 250)]
    write_lerobot(tmp_path / "set", takes, RATE, robot="iiwa")
    for found, expected in zip(read_lerobot(tmp_path / "set"), takes, strict=True):
        check_same(found, expected)
    (only,) = read_lerobot(tmp_path / "set", episodes=[1])
    check_same(only, takes[1])


def test_what_was_read_can_be_written_again(tmp_path):
    takes = [take(6), take(5, 90)]
    write_lerobot(tmp_path / "one", takes, RATE)
    write_lerobot(tmp_path / "two", read_lerobot(tmp_path / "one"), RATE)
    for found, expected in zip(read_lerobot(tmp_path / "two"), takes, strict=True):
        check_same(found, expected, copies=2)


def test_the_written_data_set_says_what_lerobot_asks_for(tmp_path):
    takes = [take(6), take(9, 90, "pour")]
    root = write_lerobot(tmp_path / "set", takes, RATE, robot="iiwa")
    info = json.loads((root / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert (info["fps"], info["total_episodes"], info["total_frames"], info["total_tasks"]) == (10, 2, 15, 2)
    assert info["features"][CAMERA]["dtype"] == "video"
    assert info["features"]["action"] == {"dtype": "float64", "shape": [7], "names": None}
    rows = parquet.read_table(root / "data/chunk-000/file-001.parquet")
    assert rows.column("index").to_pylist() == list(range(6, 15))
    assert rows.column("frame_index").to_pylist() == list(range(9))
    assert rows.schema.field("action").type == pa.list_(pa.float64(), 7)
    episodes = parquet.read_table(root / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [(e["dataset_from_index"], e["dataset_to_index"], e["length"]) for e in episodes] == [(0, 6, 6), (6, 15, 9)]
    statistics = json.loads((root / "meta/stats.json").read_text())
    both = np.concatenate([t["action"] for t in takes])
    np.testing.assert_allclose(statistics["action"]["mean"], both.mean(0))
    np.testing.assert_allclose(statistics["action"]["std"], both.std(0))
    assert np.shape(statistics[CAMERA]["mean"]) == (3, 1, 1)
    tasks = parquet.read_table(root / "meta/tasks.parquet")
    assert tasks.to_pydict() == {"task_index": [0, 1], "task": ["place the bottle", "pour"]}
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]


def test_episodes_that_share_files_are_told_apart(tmp_path):
    """Version 3 as lerobot records it: all episodes in one table and one video."""
    takes = [take(6), take(5, 90)]
    write_lerobot(tmp_path, takes, RATE)
    tables = [parquet.read_table(tmp_path / f"data/chunk-000/file-00{i}.parquet") for i in range(2)]
    parquet.write_table(pa.concat_tables(tables), tmp_path / "data/chunk-000/file-000.parquet")
    (tmp_path / "data/chunk-000/file-001.parquet").unlink()
    folder = tmp_path / "videos" / CAMERA / "chunk-000"
    (folder / "file-001.mp4").unlink()
    write_video(folder / "file-000.mp4", np.concatenate([t.frames(CAMERA) for t in takes]), RATE, codec="h264")
    path = tmp_path / "meta/episodes/chunk-000/file-000.parquet"
    rows = parquet.read_table(path).to_pylist()
    rows[1] |= {"data/file_index": 0, f"videos/{CAMERA}/file_index": 0, f"videos/{CAMERA}/from_timestamp": 0.6}
    parquet.write_table(pa.Table.from_pylist(rows), path)
    for found, expected in zip(read_lerobot(tmp_path), takes, strict=True):
        check_same(found, expected)


def test_version_2_is_read(tmp_path):
    """One table and one video per episode, JSON lines beside them, pictures inside the table."""
    takes = [take(6), take(5, 90, "pour")]
    state = {"dtype": "float32", "shape": [7], "names": None}
    features = {"observation.state": state, CAMERA: {"dtype": "video", "shape": [48, 64, 3]}}
    features |= {"wrist": {"dtype": "image", "shape": [48, 64, 3]}, "timestamp": {"dtype": "float32", "shape": [1]}}
    (tmp_path / "meta").mkdir()
    info = {"codebase_version": "v2.1", "fps": 10, "chunks_size": 1000, "features": features}
    info["data_path"] = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
    info["video_path"] = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
    (tmp_path / "meta/info.json").write_text(json.dumps(info))
    lines = [{"episode_index": i, "tasks": [t.task], "length": len(t)} for i, t in enumerate(takes)]
    (tmp_path / "meta/episodes.jsonl").write_text("\n".join(map(json.dumps, lines)))
    for i, t in enumerate(takes):
        pictures = [cv2.imencode(".png", image[:, :, ::-1])[1].tobytes() for image in t.frames(CAMERA)]
        columns = {"observation.state": t["observation.state"].tolist(), "timestamp": t.times}
        columns["wrist"] = [{"bytes": content, "path": None} for content in pictures]
        table, video = (tmp_path / info[f"{k}_path"].format(episode_chunk=0, episode_index=i, video_key=CAMERA)
                        for k in ("data", "video"))  # fmt: skip
        table.parent.mkdir(parents=True, exist_ok=True)
        video.parent.mkdir(parents=True, exist_ok=True)
        parquet.write_table(pa.table(columns), table)
        write_video(video, t.frames(CAMERA), RATE, codec="h264")
    for found, expected in zip(read_lerobot(tmp_path), takes, strict=True):
        np.testing.assert_array_equal(found["observation.state"], expected["observation.state"])
        np.testing.assert_array_equal(found.frames("wrist"), expected.frames(CAMERA))
        assert np.abs(found.frames(CAMERA).astype(float) - expected.frames(CAMERA)).mean() < 3
        assert found.task == expected.task


@pytest.mark.parametrize("kind", ["float16", "float32", "float64", "int8", "uint64", "bool", ">f4", ">i8"])
def test_numbers_keep_their_type_and_any_order_of_bytes_is_taken(tmp_path, kind):
    numbers = (np.arange(6).reshape(3, 2) % 2).astype(kind)
    write_lerobot(tmp_path, [Take({"action": numbers}, np.arange(3) / RATE)], RATE)
    found = read_lerobot(tmp_path)[0]["action"]
    assert found.dtype == np.dtype(kind).newbyteorder("=")
    np.testing.assert_array_equal(found, numbers)


def test_own_demonstrations_survive_the_way_through_lerobot(tmp_path):
    episodes = demonstrate(Robot.iiwa(), "placing", 2, 0, 5)
    rate = 1 / (episodes[0].times[1] - episodes[0].times[0])
    write_lerobot(tmp_path, [take_of_episode(e, "placing") for e in episodes], rate)
    for found, expected in zip(map(episode_of_take, read_lerobot(tmp_path)), episodes, strict=True):
        for name in ("joints", "keypoints", "actions"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
        np.testing.assert_allclose(found.times, expected.times, atol=1e-6)


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda root: (root / "meta/info.json").unlink(), r"info\.json cannot be read; is .* a LeRobot data set\?"),
        (lambda root: (root / "meta/info.json").write_text("{}"), "has no codebase_version, fps, features, data_path"),
        (lambda root: (root / "data/chunk-000/file-000.parquet").write_text("x"), "cannot be read as Parquet"),
        (lambda root: (root / "data/chunk-000/file-000.parquet").unlink(), "cannot be read as Parquet"),
        (lambda root: (root / "videos" / CAMERA / "chunk-000/file-000.mp4").unlink(), "there is no video"),
    ],
)
def test_a_broken_data_set_is_refused_by_file(tmp_path, spoil, reason):
    write_lerobot(tmp_path, [take()], RATE)
    spoil(tmp_path)
    with pytest.raises(FileError, match=reason):
        read_lerobot(tmp_path)[0].frames(CAMERA)


def test_a_video_that_is_too_short_is_refused(tmp_path):
    write_lerobot(tmp_path, [take(6)], RATE)
    write_video(tmp_path / "videos" / CAMERA / "chunk-000/file-000.mp4", film(4, 9), RATE, codec="h264")
    with pytest.raises(EpisodeError, match=r"holds 4 frames from 0\.000 s on, for 6 steps"):
        read_lerobot(tmp_path)[0].frames(CAMERA)


@pytest.mark.parametrize(
    ("takes", "rate", "reason"),
    [
        ([], RATE, "at least one take"),
        ([take(), take(extra=np.zeros(6))], RATE, "take 1 has .*extra"),
        ([take()], 3.0, "not recorded at 3 Hz"),
        ([take(**{"a/b": np.zeros(6)})], RATE, "no array of the name 'a/b'"),
        ([take(index=np.zeros(6))], RATE, "no array of the name 'index'"),
        ([take(map=np.zeros((6, 2, 2)))], RATE, "flatten it"),
        ([take(wide=np.zeros(6, np.longdouble))], RATE, r"wide has numbers of the type \w+, which LeRobot lacks"),
    ],
)
def test_takes_that_make_no_data_set_are_refused(tmp_path, takes, rate, reason):
    with pytest.raises(EpisodeError, match=reason):
        write_lerobot(tmp_path / "set", takes, rate)


def test_a_directory_that_holds_something_is_left_alone(tmp_path):
    (tmp_path / "precious").touch()
    with pytest.raises(EpisodeError, match="not empty"):
        write_lerobot(tmp_path, [take()], RATE)


def robomimic(path, rate=20):
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        if rate:
            data.attrs["env_args"] = json.dumps({"env_name": "Lift", "env_kwargs": {"control_freq": rate}})
        for i, count in enumerate((5, 7, 4)):
            demo = data.create_group(f"demo_{i + 9}")  # demo_10 comes after demo_9
            demo["actions"], demo["states"] = np.full((count, 7), float(i)), np.zeros((count, 32))
            demo["obs/robot0_joint_pos"], demo["obs/agentview_image"] = np.ones((count, 7)), film(count, 9)
            demo["next_obs/robot0_joint_pos"] = np.ones((count, 7))
            demo["rewards"], demo["dones"] = np.zeros(count), np.zeros(count, int)
        file["mask/train"] = np.array([b"demo_11", b"demo_9"])
    return path


def test_robomimic_demonstrations_are_read_in_the_order_of_their_numbers(tmp_path):
    takes = read_robomimic(robomimic(tmp_path / "low_dim.hdf5"))
    assert [t["action"][0, 0] for t in takes] == [0, 1, 2]
    assert sorted(takes[0].arrays) == ["action", "dones", "observation.robot0_joint_pos", "rewards", "states"]
    np.testing.assert_allclose(takes[1].times, np.arange(7) / 20)
    np.testing.assert_array_equal(takes[1].frames("observation.agentview_image"), film(7, 9))
    demonstration = takes[0].demonstration("observation.robot0_joint_pos", context=[1.0])
    assert demonstration.observations.shape == (5, 7)
    assert demonstration.s0.shape == (7,)


def test_a_split_of_robomimic_is_read(tmp_path):
    takes = read_robomimic(robomimic(tmp_path / "low_dim.hdf5"), split="train")
    assert [t["action"][0, 0] for t in takes] == [0, 2]


def test_robomimic_goes_to_lerobot(tmp_path):
    takes = read_robomimic(robomimic(tmp_path / "low_dim.hdf5"))
    write_lerobot(tmp_path / "set", takes, 20.0)
    for found, expected in zip(read_lerobot(tmp_path / "set"), takes, strict=True):
        check_same(found, expected)


def test_what_is_amiss_with_a_robomimic_file_is_named(tmp_path):
    path = robomimic(tmp_path / "no_rate.hdf5", rate=None)
    with pytest.raises(EpisodeError, match="does not state its control frequency"):
        read_robomimic(path)
    assert read_robomimic(path, rate=10.0)[0].times[1] == 0.1
    with pytest.raises(EpisodeError, match="no split 'test'; it has train"):
        read_robomimic(path, split="test", rate=10.0)
    (tmp_path / "text.hdf5").write_text("text")
    with pytest.raises(EpisodeError, match="cannot be read as HDF5"):
        read_robomimic(tmp_path / "text.hdf5")


def test_csv_columns_become_arrays(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("t, q1, q2, u\n0.5, 1, 2, 3\n0.6, 4, 5, 6\n")
    found = read_csv(path, {"observation.state": ["q2", "q1"], "action": ["u"]}, time="t")
    np.testing.assert_array_equal(found["observation.state"], [[2, 1], [5, 4]])
    np.testing.assert_array_equal(found["action"], [[3], [6]])
    np.testing.assert_allclose(found.times, [0, 0.1])
    np.testing.assert_allclose(read_csv(path, {"u": ["u"]}, rate=5.0).times, [0, 0.2])


@pytest.mark.parametrize("columns", [["u"], {"u": "u"}], ids=["a list", "a word"])
def test_columns_that_are_no_lists_by_names_are_refused(columns, tmp_path):
    (tmp_path / "run.csv").write_text("t,u\n0,1\n")
    with pytest.raises(EpisodeError, match=r'columns must be a dictionary such as \{"action": \["u1", "u2"\]\}, got '):
        read_csv(tmp_path / "run.csv", columns, time="t")


SYSTEMS = {"Unix": "\n", "Windows": "\r\n", "old Macintosh": "\r"}


@pytest.mark.parametrize("system", SYSTEMS)
@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"], ids=["plain", "with the mark of spreadsheets"])
def test_tables_of_every_system_are_read_with_blank_lines(system, mark, tmp_path):
    end = SYSTEMS[system]
    (tmp_path / "run.csv").write_bytes(mark + end.join(["t,u", "0,1", "", "1,2", "", "", ","]).encode())
    np.testing.assert_array_equal(read_csv(tmp_path / "run.csv", {"u": ["u"]}, time="t")["u"], [[1], [2]])
    rows = [" point, x,y ,frame", "a,1,2,0", "b,3,4,0", "", "b,7,8,1", "a,5,6,1", ""]
    (tmp_path / "tracks.csv").write_bytes(mark + end.join(rows).encode())
    tracks = read_tracks(tmp_path / "tracks.csv", rate=10.0, size=(20, 20))
    np.testing.assert_array_equal(tracks.positions, [[[1, 2], [3, 4]], [[5, 6], [7, 8]]])
    np.testing.assert_array_equal(tracks.times, [0, 0.1])


@pytest.mark.parametrize(
    ("text", "options", "reason"),
    [
        ("t,u\n0,1\n1,x\n", {"time": "t"}, "line 3, u: expected a number, got 'x'"),
        ("t,u\n0,1\n1\n", {"time": "t"}, "line 3: expected 2 entries, one for each name, got 1"),
        ("t,u\n0,1\n0,1,1,5\n", {"time": "t"}, "line 3: expected 2 entries, one for each name, got 4"),
        ("t;u\n0;1\n0,1;1,5\n", {"time": "t"}, "its columns must be separated by commas, and numbers have a decimal"),
        ("t\tu\n0\t1\n", {"time": "t"}, "its columns must be separated by commas"),
        ("t,u,u\n0,1,2\n", {"time": "t"}, "it has several columns u"),
        ("t,u\n", {"time": "t"}, "it has a line of names, and no rows"),
        ('t,u\n0,1\n1,"x\ny"\n', {"time": "t"}, r"line 4, u: expected a number, got 'x\\ny'"),
        ("t,u\n0,1\n1,nan\n", {"time": "t"}, "u holds NaN or infinity"),
        ("t,v\n0,1\n", {"time": "t"}, "has no column u; it has t, v"),
        ("t,u\n0,1\n0,2\n", {"time": "t"}, "times do not rise from step 1 on"),
        ("t,u\n0,1\n1,2\n", {}, "give either"),
        ("", {"rate": 1.0}, "it is empty"),
    ],
)
def test_what_is_amiss_with_a_csv_file_is_named(tmp_path, text, options, reason):
    (tmp_path / "run.csv").write_text(text)
    with pytest.raises(EpisodeError, match=reason):
        read_csv(tmp_path / "run.csv", {"u": ["u"]}, **options)


def test_plain_arrays_become_a_take(tmp_path):
    np.savez(tmp_path / "run.npz", q=np.ones((4, 7)), u=np.zeros((4, 2)), clock=np.arange(4) * 0.2)
    found = read_npz(tmp_path / "run.npz", time="clock")
    assert sorted(found.arrays) == ["q", "u"]
    np.testing.assert_allclose(found.times, [0, 0.2, 0.4, 0.6])
    assert found.demonstration("q").observations.shape == (4, 7)
    np.savez(tmp_path / "uneven.npz", q=np.ones((4, 7)), u=np.zeros((3, 2)))
    with pytest.raises(EpisodeError, match=r"uneven\.npz: all arrays of an episode need"):
        read_npz(tmp_path / "uneven.npz", rate=1.0)
    np.savez(tmp_path / "objects.npz", q=np.array([None]))
    with pytest.raises(EpisodeError, match="cannot be read as plain arrays"):
        read_npz(tmp_path / "objects.npz", rate=1.0)


def test_a_name_that_is_not_there_is_answered_with_those_that_are():
    with pytest.raises(EpisodeError, match=r"no 'joints'; it has observation\.state, action"):
        take()["joints"]
    with pytest.raises(EpisodeError, match=f"no camera 'wrist'; it has {CAMERA}"):
        take().frames("wrist")
