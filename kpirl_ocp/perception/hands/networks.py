"""The two networks that find a hand: taken from the wheel of mediapipe (Apache-2.0), whose later versions hold none.

    python -m kpirl_ocp.perception.hands.networks

downloads the wheel from the package registry with pip and keeps the two files; nothing of it is installed.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

from kpirl_ocp.episodes import atomic_write
from kpirl_ocp.errors import DependencyError

_WHEEL = "mediapipe==0.10.21"
_TARGET = ("--python-version", "3.11", "--platform", "manylinux_2_28_x86_64")  # data, the same for all
_FILES = {
    "palm": "mediapipe/modules/palm_detection/palm_detection_full.tflite",
    "landmarks": "mediapipe/modules/hand_landmark/hand_landmark_full.tflite",
}
FETCH = f"{Path(sys.executable).name} -m kpirl_ocp.perception.hands.networks"


def folder() -> Path:
    """Where the networks are kept, in the user's cache."""
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(cache) / "kpirl_ocp" / "hands"


def network(name: str) -> Path:
    """The file of "palm" or "landmarks". Raises DependencyError, with the command that brings it, if there is none."""
    path = folder() / f"{name}.tflite"
    if not path.is_file():
        raise DependencyError(f"the networks that find a hand are not there: fetch them with `{FETCH}`.")
    return path


def are_there() -> bool:
    """Whether both networks have been fetched."""
    return all((folder() / f"{name}.tflite").is_file() for name in _FILES)


def fetch() -> Path:
    """Download the wheel and keep the two networks. Raises DependencyError, with pip's words, if that fails."""
    with tempfile.TemporaryDirectory() as directory:
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary", ":all:"]
        done = subprocess.run([*command, *_TARGET, "--dest", directory, _WHEEL], capture_output=True, text=True)
        wheels = list(Path(directory).glob("*.whl"))
        if done.returncode or not wheels:
            raise DependencyError(f"pip cannot download {_WHEEL}: {done.stderr.strip()}")
        folder().mkdir(parents=True, exist_ok=True)
        with zipfile.ZipFile(wheels[0]) as wheel:
            for name, path in _FILES.items():
                with atomic_write(folder() / f"{name}.tflite") as file:
                    file.write(wheel.read(path))
    return folder()


if __name__ == "__main__":
    print(fetch())
