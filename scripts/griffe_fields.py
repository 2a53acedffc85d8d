"""For the reference pages: the fields of a docstring ("name: what it is", a line each) become a list.

psi: (n_psi,) parameters.        ->        * `psi`: (n_psi,) parameters.
"""

import re
from typing import Any

import griffe

_FIELD = re.compile(r"^([a-z_]\w*(?:, \w+)*): (?=\S)", re.MULTILINE)


def with_list(text: str) -> str:
    """The text of a docstring with its fields as items; what Google's sections hold is indented, and stays."""
    return _FIELD.sub(lambda found: f"\n* `{found[1]}`: ", text)


class Fields(griffe.Extension):
    """Griffe calls this for every object of the package."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite the docstring."""
        if obj.docstring is not None:
            obj.docstring.value = with_list(obj.docstring.value)
