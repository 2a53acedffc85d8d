"""Near matches for misspelt names, for messages."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def suggestion(word: str, known: Iterable[str]) -> str:
    """ ": did you mean X?" with the nearest of the known names, be it in capitals, or nothing if none is near."""
    names = {name.casefold(): name for name in known}
    near = difflib.get_close_matches(word.casefold(), names, n=1)
    return f": did you mean {names[near[0]]!r}?" if near else ""
