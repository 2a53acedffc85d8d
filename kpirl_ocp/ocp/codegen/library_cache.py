"""The cache of shared libraries, which belong to this user and are loaded only as they were built.

A library ends with the digest of the rest of it, so that one that was truncated, emptied or damaged is built again. The
cache is shared between processes and bounded: beyond `_CACHE_BYTES` the libraries that were not used for longest are
removed.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import struct
from collections.abc import Callable
from pathlib import Path

from kpirl_ocp.errors import CompilerError

_CACHE_BYTES = 512 * 2**20
_DIGEST = 64  # characters of SHA-256


def cached(name: str, key: str, build: Callable[[Path], None]) -> Path:
    """The library with this key: from the cache, marked as used, or built by `build(path)`.

    Raises:
        CompilerError: others may write the cache.
    """
    library = place(name, key)
    with contextlib.suppress(FileNotFoundError):
        if sound(library):
            with contextlib.suppress(PermissionError):  # a shared cache that may only be read
                os.utime(library)
            return library
    build(library)
    _evict(library)
    return library


def place(name: str, key: str) -> Path:
    """Where the library with this key is, or has to be; the directory is made.

    Raises:
        CompilerError: others may write the cache.
    """
    directory = cache_directory()
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    if _exposed(directory):
        raise CompilerError(
            f"other users may write to {directory}, so no code is loaded from it: "
            "revoke that permission (chmod go-w), or set XDG_CACHE_HOME to another directory."
        )
    return directory / f"{name}-{hashlib.sha256(key.encode()).hexdigest()[:32]}.so"


def cache_directory() -> Path:
    """The directory of compiled code: $XDG_CACHE_HOME/kpirl_ocp, by default ~/.cache/kpirl_ocp."""
    root = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(root) / "kpirl_ocp"


def seal(library: Path) -> None:
    """Append the digest of a library, and let nobody else write it."""
    digest = hashlib.sha256(library.read_bytes()).hexdigest()
    with library.open("ab") as file:
        file.write(digest.encode())
    library.chmod(0o700)


def sound(library: Path) -> bool:
    """Whether this is a whole shared library, sealed, that nobody else may write. Raises FileNotFoundError."""
    if _exposed(library):
        return False
    content = library.read_bytes()
    body, digest = content[:-_DIGEST], content[-_DIGEST:]
    return hashlib.sha256(body).hexdigest().encode() == digest and _whole(body)


def _exposed(path: Path) -> bool:
    """Whether others than this user and root may write a file or directory."""
    found = path.stat()
    return found.st_uid not in (0, os.getuid()) or bool(found.st_mode & 0o022)


def _whole(content: bytes) -> bool:
    """Whether this is an ELF file up to its section headers, with which it ends: a truncated one stops the process."""
    if len(content) < 64 or content[:4] != b"\x7fELF":
        return False
    order = "<" if content[5] == 1 else ">"
    at, sizes, kind = (0x28, 0x3A, "Q") if content[4] == 2 else (0x20, 0x2E, "I")
    (start,) = struct.unpack_from(order + kind, content, at)
    size, count = struct.unpack_from(order + "HH", content, sizes)
    return bool(start + size * count <= len(content))


def _evict(newest: Path) -> None:
    """Remove the libraries that were not used for longest, until the cache fits; never the newest."""
    libraries = []
    for path in newest.parent.glob("*.so"):
        with contextlib.suppress(FileNotFoundError):  # removed by another process meanwhile
            libraries.append((path.stat().st_mtime_ns, path.stat().st_size, path))
    excess = sum(size for _, size, _ in libraries) - _CACHE_BYTES
    for _, size, path in sorted(libraries):
        if excess > 0 and path != newest:
            path.unlink(missing_ok=True)
            excess -= size
