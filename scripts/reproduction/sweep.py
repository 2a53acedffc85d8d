"""A sweep: many independent jobs, in parallel here or on a cluster, each result kept on disk as soon as it is there.

A job is a plain function with plain arguments that returns a flat dictionary of numbers and arrays. Its result is
stored under its name and a hash of all its arguments, so that a sweep that was stopped goes on, and results of other
settings are never mixed in.
"""

from __future__ import annotations

import contextlib
import hashlib
import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import joblib
import numpy as np
from tqdm import tqdm

from kpirl_ocp.episodes import atomic_write
from kpirl_ocp.errors import DependencyError, ProblemError

Result = dict[str, Any]
BACKENDS = ("loky", "dask", "ray")


@dataclass(frozen=True)
class Job:
    """`function(**arguments)`; `name` is unique in its sweep and may be a path with slashes."""

    name: str
    function: Callable[..., Result]
    arguments: Mapping[str, Any]

    def path(self, directory: Path) -> Path:
        """File of its result."""
        code = hashlib.sha256(inspect.getsource(self.function).encode()).hexdigest()
        key = joblib.hash((code, dict(self.arguments)))
        return directory / f"{self.name}-{key[:16]}.npz"


def run_sweep(title: str, jobs: Sequence[Job], directory: Path, workers: int) -> dict[str, Result]:
    """Results by name; what is on disk is read, the rest is run. Progress and time left go to stderr."""
    paths = {job.name: job.path(directory) for job in jobs}
    if len(paths) < len(jobs):
        raise ProblemError(f"{title}: the names of jobs must differ.")
    missing = [job for job in jobs if not paths[job.name].exists()]
    for path in paths.values():
        path.parent.mkdir(parents=True, exist_ok=True)
    parallel = joblib.Parallel(workers, return_as="generator_unordered")
    finished = parallel(joblib.delayed(_call)(job) for job in missing)
    for name, result in tqdm(finished, title, initial=len(jobs) - len(missing), total=len(jobs), unit="job"):
        with atomic_write(paths[name]) as file:
            np.savez_compressed(file, allow_pickle=False, **result)
    return {name: _read(path) for name, path in paths.items()}


def _call(job: Job) -> tuple[str, Result]:
    return job.name, job.function(**job.arguments)


def _read(path: Path) -> Result:
    with np.load(path, allow_pickle=False) as file:
        return {key: value[()] for key, value in file.items()}


@contextlib.contextmanager
def backend(name: str, address: str | None, workers: int) -> Iterator[None]:
    """Context in which joblib runs the jobs: "loky" here, "dask" or "ray" at an address (None: a cluster of `workers`).

    A cluster's machines need the package, and the models at the same paths.

    Raises DependencyError if the package of a backend is not installed.
    """
    try:
        manager = {"loky": _loky, "dask": _dask, "ray": _ray}[name](address, workers)
    except ImportError as error:
        raise DependencyError(
            f"--backend {name} needs its package: pip install 'kpirl-ocp[{name}]' ({error})."
        ) from None
    with manager:
        yield


def _loky(address: str | None, workers: int) -> contextlib.AbstractContextManager[Any]:
    if address is not None:
        raise ProblemError("--address is for --backend dask or ray; loky runs on this machine.")
    return joblib.parallel_config("loky")


@contextlib.contextmanager
def _running_dask(address: str | None, workers: int) -> Iterator[None]:
    from dask.distributed import Client, LocalCluster

    with contextlib.ExitStack() as stack:
        if address is None:
            cluster = LocalCluster(workers, threads_per_worker=1, dashboard_address=None)
            address = stack.enter_context(cluster).scheduler_address
        stack.enter_context(Client(address))
        _send_by_value()
        stack.enter_context(joblib.parallel_config("dask"))
        yield


def _dask(address: str | None, workers: int) -> contextlib.AbstractContextManager[Any]:
    import dask.distributed  # noqa: F401  (to fail here and not later)

    return _running_dask(address, workers)


def _ray(address: str | None, workers: int) -> contextlib.AbstractContextManager[Any]:
    import ray
    from ray.util.joblib import register_ray

    ray.init(address=address, num_cpus=workers if address is None else None)
    register_ray()
    _send_by_value()
    return joblib.parallel_config("ray")


def _send_by_value() -> None:
    """Workers elsewhere have the package installed, but not these scripts: send the scripts along."""
    import cloudpickle

    import reproduction

    cloudpickle.register_pickle_by_value(reproduction)
