"""A limit on the memory of a command, so that too large a problem ends with an error message and is not killed."""

from __future__ import annotations

import contextlib
import os
import resource
from collections.abc import Iterator

from kpirl_ocp.errors import ResourceError


@contextlib.contextmanager
def within_memory() -> Iterator[None]:
    """A context that may use as much memory as the machine has, or less if there is a limit already.

    Raises ResourceError if it needs more.
    """
    limit, most = before = resource.getrlimit(resource.RLIMIT_DATA)
    if limit == resource.RLIM_INFINITY:
        limit = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        resource.setrlimit(resource.RLIMIT_DATA, (limit if most == resource.RLIM_INFINITY else min(limit, most), most))
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "bad_alloc" not in str(error):  # the C++ exception, passed on by CasADi
            raise
        there = f"the {limit / 2**30:.1f} GiB that there are"
        raise ResourceError(
            f"this takes more memory than {there}: ask for fewer steps, episodes or processes"
        ) from error
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)
