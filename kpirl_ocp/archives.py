"""Archives of arrays (.npz) from elsewhere: their sizes are looked at before memory is taken."""

from __future__ import annotations

import math
from pathlib import Path
from zipfile import ZipFile, is_zipfile

import numpy as np

_LARGEST = 2 * 2**30  # [bytes] of one file, unpacked; an episode of camera images has some 10 MB


def check_size(path: Path) -> None:
    """Look at the sizes that an archive of arrays and the headers in it announce.

    Raises:
        ValueError: more than 2 GiB in all, or a header that announces more than is there.
    """
    if not is_zipfile(path):
        return
    with ZipFile(path) as archive:
        members = archive.infolist()
        total = sum(member.file_size for member in members)
        if total > _LARGEST:
            raise ValueError(f"it unpacks to {total / 2**30:.1f} GiB; at most {_LARGEST / 2**30:.0f} GiB are read.")
        for member in members:
            with archive.open(member) as file:
                version = np.lib.format.read_magic(file)
                read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
                shape, _, dtype = read(file)
            if math.prod(shape) * dtype.itemsize > member.file_size:
                raise ValueError(f"{member.filename} announces an array of {shape} {dtype}, and is too short for it.")
