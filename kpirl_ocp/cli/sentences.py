"""Errors of files and values, with the option that brought them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from kpirl_ocp.errors import KpirlError, OptionError


@contextlib.contextmanager
def of_option(name: str) -> Iterator[None]:
    """A context that reads the value of an option; its errors become OptionErrors that begin with its name."""
    try:
        yield
    except (KpirlError, OSError) as error:
        words = str(error)
        raise OptionError(words if words.startswith("--") else f"{name}: {words}") from error
