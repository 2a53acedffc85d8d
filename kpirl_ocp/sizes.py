"""Looks at files from elsewhere, before they are opened, and at sizes, before memory is taken."""

from __future__ import annotations

import json
import stat
from pathlib import Path
from typing import Any

LONGEST = 1_000_000  # steps of a horizon, or of gradient descent
LARGEST = 2 * 2**30  # [bytes] of one file, unpacked; an episode of camera images has some 10 MB
_LARGEST_TEXT = 2**28  # [bytes]; a cost has some kB, the table of a large data set some MB
_KINDS = {
    stat.S_IFDIR: "a directory",
    stat.S_IFIFO: "a FIFO",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def check_bytes(count: int) -> None:
    """Raise ValueError for more than 2 GiB."""
    if count > LARGEST:
        raise ValueError(f"it unpacks to {count / 2**30:.1f} GiB; at most {LARGEST / 2**30:g} GiB are read.")


def check_file(path: Path) -> None:
    """Look at what a path names before it is opened: opening a FIFO waits for somebody who writes.

    Raises:
        OSError: there is nothing, or it may not be looked at.
        ValueError: a directory, FIFO, device or socket.
    """
    kind = stat.S_IFMT(path.stat().st_mode)
    if kind != stat.S_IFREG:
        raise ValueError(f"it is {_KINDS.get(kind, 'something else')}, and not a file.")


def read_text(path: Path) -> str:
    """The text of a file.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is no regular file, has more than 256 MiB, or is not UTF-8.
    """
    check_file(path)
    with path.open("rb") as file:
        content = file.read(_LARGEST_TEXT + 1)
    if len(content) > _LARGEST_TEXT:
        raise ValueError(f"it has more than {_LARGEST_TEXT // 2**20} MiB of text.")
    try:
        return content.decode()
    except UnicodeDecodeError as error:  # whose own words hold the whole content
        raise ValueError(f"it is not text in UTF-8: {error.reason} at byte {error.start}.") from None


def read_json(path: Path) -> Any:
    """The content of a JSON file; errors as in `read_text`, and ValueError for what is no JSON."""
    try:
        return json.loads(read_text(path))
    except RecursionError:
        raise ValueError("it is nested too deeply.") from None
