"""Sweeps of independent jobs: results are kept, resumed, never mixed, and the same on every backend."""

import re
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from kpirl_ocp.errors import DependencyError, ProblemError

SCRIPTS = Path(__file__).parents[1] / "scripts"


@pytest.fixture
def sweep(monkeypatch):
    monkeypatch.syspath_prepend(SCRIPTS)
    from reproduction import sweep

    return sweep


def here(sweep):
    """Runs jobs in this process."""
    return sweep.with_joblib(1)


def double(value, log=None):
    """Twice the value; each call leaves a line in `log`."""
    if log is not None:
        with Path(log).open("a") as file:
            file.write(f"{value}\n")
    if value == 13:
        raise ProblemError("13 cannot be doubled.")
    return {"twice": 2 * value, "row": np.arange(value)}


def jobs(sweep, values, log):
    return [sweep.Job(f"doubled/{value}", double, {"value": value, "log": str(log)}) for value in values]


def test_every_job_gives_its_result_under_its_name(sweep, tmp_path):
    found = sweep.run_sweep("test", jobs(sweep, [1, 2], tmp_path / "log"), tmp_path, here(sweep))
    assert found["doubled/2"]["twice"] == 4
    assert found["doubled/2"]["row"].tolist() == [0, 1]
    assert list(found) == ["doubled/1", "doubled/2"]


def test_a_sweep_that_was_stopped_goes_on_where_it_was(sweep, tmp_path):
    log = tmp_path / "log"
    with pytest.raises(ProblemError, match="13"):
        sweep.run_sweep("test", jobs(sweep, [1, 2, 13, 4], log), tmp_path, here(sweep))
    found = sweep.run_sweep("test", jobs(sweep, [1, 2, 4], log), tmp_path, here(sweep))
    assert len(found) == 3
    assert sorted(log.read_text().split()) == ["1", "13", "2", "4"]
    assert not list(tmp_path.rglob("*.part"))


def test_other_arguments_are_another_result(sweep, tmp_path):
    first = sweep.Job("same name", double, {"value": 1})
    second = sweep.Job("same name", double, {"value": 2})
    assert sweep.run_sweep("test", [first], tmp_path, here(sweep))["same name"]["twice"] == 2
    assert sweep.run_sweep("test", [second], tmp_path, here(sweep))["same name"]["twice"] == 4
    assert sweep.run_sweep("test", [first], tmp_path, here(sweep))["same name"]["twice"] == 2


def test_arrays_and_settings_decide_where_a_result_is_kept(sweep, tmp_path):
    paths = {sweep.Job("j", double, {"value": np.array(values)}).path(tmp_path) for values in ([1, 2], [1, 3], [1, 2])}
    assert len(paths) == 2


def test_two_jobs_of_one_name_are_refused(sweep, tmp_path):
    with pytest.raises(ProblemError, match="names of jobs must differ"):
        sweep.run_sweep("test", [sweep.Job("a", double, {"value": v}) for v in (1, 2)], tmp_path, here(sweep))


def test_another_version_is_another_result(sweep, tmp_path, monkeypatch):
    job = sweep.Job("j", double, {"value": 1})
    before = job.path(tmp_path)
    monkeypatch.setattr("kpirl_ocp.__version__", "99.0")
    sweep.package_state.cache_clear()
    assert job.path(tmp_path) != before


def test_other_code_of_the_package_is_another_result_but_caches_are_not(sweep, tmp_path, monkeypatch):
    job, paths = sweep.Job("j", double, {"value": 1}), []
    monkeypatch.setattr("kpirl_ocp.__file__", str(tmp_path / "__init__.py"))
    for name, text in (("solver.py", "1"), ("solver.pyc", "1"), ("solver.py", "2"), ("core.c", "1"), ("core.c", "2")):
        (tmp_path / name).write_text(text)
        sweep.package_state.cache_clear()
        paths.append(job.path(tmp_path))
    assert paths[0] == paths[1]
    assert len(set(paths[1:])) == 4


@pytest.fixture
def cluster(request, tmp_path, monkeypatch):
    """Backend and address of a cluster with one worker that has the package but not the scripts; None: its own."""
    if request.param == "ray":
        pytest.importorskip("ray")
        monkeypatch.chdir(tmp_path)
        yield "ray", None
        return
    deploy = pytest.importorskip("distributed.deploy.subprocess")
    options = {"host": "127.0.0.1", "n_workers": 1, "threads_per_worker": 1, "scheduler_kwargs": {"dashboard": False}}
    with deploy.SubprocessCluster(**options) as running:
        yield "dask", running.scheduler_address


@pytest.mark.parametrize("cluster", ["dask", "ray"], indirect=True)
def test_a_cluster_is_sent_the_scripts_and_gives_the_same_results_as_this_process(cluster, sweep, tmp_path):
    from experiments.study import StudySettings

    def study(tests):
        return [sweep.Job(f"settings-{count}", asdict, {"obj": StudySettings(tests=count)}) for count in tests]

    name, address = cluster
    with sweep.backend(name, address, 1) as run:
        found = sweep.run_sweep(name, study([1, 2, 3]), tmp_path / "there", run)
        with pytest.raises(TypeError, match="dataclass"):
            sweep.run_sweep(name, [sweep.Job("wrong", asdict, {"obj": 13})], tmp_path / "there", run)
    assert found == sweep.run_sweep("here", study([1, 2, 3]), tmp_path / "here", here(sweep))


def test_dask_begins_a_cluster_of_its_own_without_an_address(sweep, tmp_path):
    pytest.importorskip("distributed")
    with sweep.backend("dask", None, 2) as run:
        found = sweep.run_sweep("dask", jobs(sweep, [1, 2, 3], tmp_path / "log"), tmp_path / "there", run)
    assert {name: result["twice"] for name, result in found.items()} == {f"doubled/{v}": 2 * v for v in (1, 2, 3)}


def test_a_backend_that_is_not_installed_says_how_to_get_it(sweep, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    with pytest.raises(DependencyError, match=r"pip install 'kpirl-ocp\[ray\]'"), sweep.backend("ray", None, 1):
        pass


@pytest.mark.parametrize("address", ["127.0.0.1:1", "tcp://127.0.0.1:1", "nonsense", "127.0.0.1:99999", "[]:x"])
def test_an_address_at_which_nothing_listens_is_refused_at_once(address, sweep):
    with pytest.raises(
        ProblemError, match=re.escape(f"--address: expected HOST:PORT of a running cluster, got '{address}'")
    ):
        sweep.check_address(address)


def test_an_address_without_a_cluster_is_refused(sweep):
    with pytest.raises(ProblemError, match="--address"), sweep.backend("loky", "tcp://somewhere:8786", 1):
        pass
