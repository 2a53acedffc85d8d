"""Objects of JSON files as arguments of dataclasses; what does not fit is refused in a sentence that names it."""

from __future__ import annotations

from dataclasses import MISSING, fields
from typing import Any

from kpirl_ocp.ocp.problem.statement.checks import shown

# By the annotation of a field; other fields are checked by the class.
_TYPES: dict[str, tuple[str, tuple[type, ...]]] = {
    "float": ("a number", (int, float)),
    "int": ("a whole number", (int,)),
    "int | None": ("a whole number or null", (int, type(None))),
    "bool": ("true or false", (bool,)),
    "str": ("a string", (str,)),
}


def an_object(name: str, value: Any) -> dict[str, Any]:
    """A JSON object. Raises ValueError for anything else."""
    if not isinstance(value, dict):
        raise ValueError(f"{name} must be an object, got {shown(value)}")
    return value


def a_list(name: str, value: Any) -> list[Any]:
    """A JSON array. Raises ValueError for anything else."""
    if not isinstance(value, list):
        raise ValueError(f"{name} must be a list, got {shown(value)}")
    return value


def a_value(name: str, value: Any, annotation: str) -> Any:
    """A value of the type that an annotation names. Raises ValueError for another type."""
    expected, types = _TYPES[annotation]
    if not isinstance(value, types) or (isinstance(value, bool) and bool not in types):
        raise ValueError(f"{name} must be {expected}, got {shown(value)}")
    return value


def fields_of(kind: type, name: str, content: Any) -> dict[str, Any]:
    """The arguments of a dataclass in an object called `name`.

    Raises ValueError for anything but an object, and for fields that are missing, unknown or of another type.
    """
    given, known = an_object(name, content), {field.name: field for field in fields(kind)}
    for key, field in known.items():
        if key not in given and field.default is MISSING:
            raise ValueError(f"{name} has no {key!r}")
    for key, value in given.items():
        if key not in known:
            raise ValueError(f"{name} has an unknown field {key!r}; it may have: {', '.join(known) or 'none'}")
        if str(known[key].type) in _TYPES:
            a_value(f"{name}.{key}", value, str(known[key].type))
    return given
