"""A sweep: many independent jobs, in parallel here or on a cluster, each result kept on disk as soon as it is there.

A job is a plain function with plain arguments that returns a flat dictionary of numbers and arrays. Its result is
stored under its name and a hash of all that it depends on (arguments, code, versions), so that a sweep that was stopped
resumes, and results of other settings or of other code are never mixed in.
"""

from __future__ import annotations

import contextlib
import hashlib
import inspect
import logging
import signal
import socket
import tempfile
import warnings
import zipfile
import zlib
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import joblib
import numpy as np
from tqdm import tqdm

import kpirl_ocp
from kpirl_ocp.episodes import atomic_write, check_archive
from kpirl_ocp.errors import DependencyError, FileError, ProblemError
from kpirl_ocp.reporting import deaf_pool, results_of

Result = dict[str, Any]
# What jobs are made of: workers elsewhere have the package installed, but not these, and are sent them.
SCRIPTS = tuple(Path(__file__).parents[1] / name for name in ("experiments", "reproduction"))


@dataclass(frozen=True)
class Job:
    """`function(**arguments)`; `name` is unique in its sweep and may be a path with slashes."""

    name: str
    function: Callable[..., Result]
    arguments: Mapping[str, Any]

    def path(self, directory: Path) -> Path:
        """File of its result, named after all that it depends on."""
        module = inspect.getmodule(self.function)
        code = inspect.getsource(module or self.function)
        key = joblib.hash((self.function.__qualname__, code, dict(self.arguments), package_state()))
        return directory / f"{self.name}-{key[:16]}.npz"


Running = Generator[tuple[str, Result], None, None]
Runner = Callable[[Sequence[Job]], Running]
"""Runs jobs and gives names and results as they come; closing it stops them."""


@lru_cache
def package_state() -> tuple[str, ...]:
    """Versions of the package and of what computes for it, and a hash of the package's sources, as clones change."""
    root, digest = Path(kpirl_ocp.__file__).parent, hashlib.sha256()
    for path in sorted(path for path in root.rglob("*") if path.suffix in (".py", ".c", ".h")):
        digest.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes())
    return kpirl_ocp.__version__, *map(version, ("casadi", "numpy", "scipy")), digest.hexdigest()


def run_sweep(title: str, jobs: Sequence[Job], directory: Path, run: Runner) -> dict[str, Result]:
    """Results by name; what is on disk is read, the rest is run. Progress and time left go to stderr."""
    paths = {job.name: job.path(directory) for job in jobs}
    if len(paths) < len(jobs):
        raise ProblemError(f"{title}: the names of jobs must differ.")
    missing = [job for job in jobs if not paths[job.name].exists()]
    for path in paths.values():
        path.parent.mkdir(parents=True, exist_ok=True)
    bar: dict[str, Any] = {"desc": title, "initial": len(jobs) - len(missing), "total": len(jobs), "unit": "job"}
    with warnings.catch_warnings(), contextlib.closing(run(missing)) as running:
        warnings.filterwarnings("ignore", r"\d+ tasks which")  # joblib's, of jobs that an interruption cancels
        for name, result in tqdm(running, **bar):
            with atomic_write(paths[name]) as file:
                np.savez_compressed(file, allow_pickle=False, **result)
    return {name: _read(path) for name, path in paths.items()}


def _call(job: Job) -> tuple[str, Result]:
    return job.name, job.function(**job.arguments)


def _read(path: Path) -> Result:
    try:
        check_archive(path)
        with np.load(path, allow_pickle=False) as file:
            return {key: value[()] for key, value in file.items()}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise FileError(f"{path} is no finished result ({error}): remove it, and run the command again.") from error


@contextlib.contextmanager
def backend(name: str, address: str | None, workers: int) -> Iterator[Runner]:
    """The runner of jobs: "loky" here, "dask" or "ray" at an address (None: a cluster of `workers` processes here).

    A cluster's machines need the package, and the models at the same paths.

    Raises DependencyError if the package of a backend is not installed.
    """
    with contextlib.ExitStack() as stack:
        try:
            yield stack.enter_context({"loky": _loky, "dask": _dask, "ray": _ray}[name](address, workers))
        except ModuleNotFoundError as error:
            if error.name not in ("dask", "distributed", "ray"):
                raise
            raise DependencyError(f"--backend {name} needs its package: pip install 'kpirl-ocp[{name}]'.") from None


def check_address(address: str) -> None:
    """Raise ProblemError if nothing listens at [SCHEME://]HOST:PORT; clusters take minutes to say so."""
    host, _, port = address.rpartition("/")[2].rpartition(":")
    try:
        socket.create_connection((host, int(port)), timeout=10).close()
    except (OSError, ValueError, OverflowError) as error:
        raise ProblemError(f"--address: expected HOST:PORT of a running cluster, got {address!r}: {error}.") from error


@contextlib.contextmanager
def _loky(address: str | None, workers: int) -> Iterator[Runner]:
    if address is not None:
        raise ProblemError("--address is for --backend dask or ray; loky runs on this machine.")
    yield with_joblib(workers)


def with_joblib(workers: int) -> Runner:
    """Processes on this machine, or where joblib is configured to run now."""
    parallel = joblib.Parallel(workers, return_as="generator_unordered")

    def run(jobs: Sequence[Job]) -> Running:
        return results_of(parallel, (joblib.delayed(_call)(job) for job in jobs))

    return run


@contextlib.contextmanager
def _dask(address: str | None, workers: int) -> Iterator[Runner]:
    from dask.distributed import Client, LocalCluster

    with contextlib.ExitStack() as stack:
        stack.callback(logging.disable, logging.NOTSET)
        if address is None:
            with deaf_pool():
                # Any port that is free. Entered in the block: a signal that waits for the end of the block closes it.
                cluster = stack.enter_context(LocalCluster(workers, threads_per_worker=1, dashboard_address=":0"))
            client = stack.enter_context(Client(cluster))
            client.run(logging.getLogger("distributed.worker.state_machine").setLevel, "ERROR")  # of cancelled jobs
        else:
            client = stack.enter_context(Client(address))
        directory = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        client.upload_file(str(zip_scripts(directory / "kpirl_scripts.zip")))
        stack.callback(logging.disable, logging.CRITICAL)  # of connections and workers that are being closed
        with joblib.parallel_config("dask", wait_for_workers_timeout=60):
            runner = with_joblib(workers)
        yield runner


@contextlib.contextmanager
def _ray(address: str | None, workers: int) -> Iterator[Runner]:
    import ray

    local = {} if address else {"num_cpus": workers, "include_dashboard": False}

    def run(jobs: Sequence[Job]) -> Running:
        task = ray.remote(_call)
        waiting = [task.remote(job) for job in jobs]
        while waiting:
            (done, *_), waiting = ray.wait(waiting)
            yield ray.get(done)

    try:
        with _handler_of_sigterm_kept():
            ray.init(address=address or "local", runtime_env={"py_modules": [str(path) for path in SCRIPTS]}, **local)
        yield run
    finally:
        ray.shutdown()


@contextlib.contextmanager
def _handler_of_sigterm_kept() -> Iterator[None]:
    """A block in which Ray begins, whose own handler ends the process without a word: here it is an interruption."""
    before = signal.getsignal(signal.SIGTERM)
    try:
        yield
    except SystemExit:
        raise KeyboardInterrupt from None
    finally:
        signal.signal(signal.SIGTERM, before)


def zip_scripts(path: Path) -> Path:
    """The scripts' modules in a file that Python can import from."""
    with zipfile.ZipFile(path, "w") as archive:
        for file in (file for package in SCRIPTS for file in package.rglob("*.py")):
            archive.write(file, file.relative_to(SCRIPTS[0].parent))
    return path
