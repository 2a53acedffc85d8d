"""Sweeps of independent jobs: results are kept, resumed, never mixed, and the same on every backend."""

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
    found = sweep.run_sweep("test", jobs(sweep, [1, 2], tmp_path / "log"), tmp_path, 1)
    assert found["doubled/2"]["twice"] == 4
    assert found["doubled/2"]["row"].tolist() == [0, 1]
    assert list(found) == ["doubled/1", "doubled/2"]


def test_a_sweep_that_was_stopped_goes_on_where_it_was(sweep, tmp_path):
    log = tmp_path / "log"
    with pytest.raises(ProblemError, match="13"):
        sweep.run_sweep("test", jobs(sweep, [1, 2, 13, 4], log), tmp_path, 1)
    found = sweep.run_sweep("test", jobs(sweep, [1, 2, 4], log), tmp_path, 1)
    assert len(found) == 3
    assert sorted(log.read_text().split()) == ["1", "13", "2", "4"]
    assert not list(tmp_path.rglob("*.part"))


def test_other_arguments_are_another_result(sweep, tmp_path):
    first = sweep.Job("same name", double, {"value": 1})
    second = sweep.Job("same name", double, {"value": 2})
    assert sweep.run_sweep("test", [first], tmp_path, 1)["same name"]["twice"] == 2
    assert sweep.run_sweep("test", [second], tmp_path, 1)["same name"]["twice"] == 4
    assert sweep.run_sweep("test", [first], tmp_path, 1)["same name"]["twice"] == 2


def test_arrays_and_settings_decide_where_a_result_is_kept(sweep, tmp_path):
    paths = {sweep.Job("j", double, {"value": np.array(values)}).path(tmp_path) for values in ([1, 2], [1, 3], [1, 2])}
    assert len(paths) == 2


def test_two_jobs_of_one_name_are_refused(sweep, tmp_path):
    with pytest.raises(ProblemError, match="names of jobs must differ"):
        sweep.run_sweep("test", [sweep.Job("a", double, {"value": v}) for v in (1, 2)], tmp_path, 1)


def test_dask_gives_the_same_results_as_this_machine(sweep, tmp_path):
    pytest.importorskip("distributed")
    here = sweep.run_sweep("here", jobs(sweep, [1, 2, 3], tmp_path / "a"), tmp_path / "here", 1)
    with sweep.backend("dask", None, 2):
        there = sweep.run_sweep("dask", jobs(sweep, [1, 2, 3], tmp_path / "b"), tmp_path / "there", 2)
    assert {name: found["twice"] for name, found in there.items()} == {name: here[name]["twice"] for name in here}


def test_a_backend_that_is_not_installed_says_how_to_get_it(sweep, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    with pytest.raises(DependencyError, match=r"pip install 'kpirl-ocp\[ray\]'"), sweep.backend("ray", None, 1):
        pass


def test_an_address_without_a_cluster_is_refused(sweep):
    with pytest.raises(ProblemError, match="--address"), sweep.backend("loky", "tcp://somewhere:8786", 1):
        pass
