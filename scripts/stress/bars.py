"""Bars that the numbers must meet, and sentences for those missed."""

from __future__ import annotations

from typing import Any

_HEALTHY, _MEGABYTES = 0.95, 20.0
_MEAN = 0.7  # of iterations, relative to Ipopt's


def broken(numbers: dict[str, Any]) -> list[str]:
    """One sentence for every bar that is missed."""
    found = []
    contest, statuses = numbers.get("certificates"), numbers.get("statuses")
    if contest and contest["wrong"]:
        found.append(f"certified and wrong: cases {contest['wrong']}.")
    if contest and contest["healthy"] < _HEALTHY:
        found.append(f"only {100 * contest['healthy']:.1f} % of the healthy cases are certified.")
    if statuses and statuses["wrong"]:
        found.append(f"statuses that are not confirmed: {statuses['wrong']}.")
    starts = numbers.get("starts", {}).get("all")
    if starts and (starts["lost"] or starts["many"] or not starts["mean"] <= _MEAN):
        found.append(f"iterations from noisy starts: {starts}.")
    between = numbers.get("obstacles", {}).get("all")
    if between and between["lost"]:
        found.append(f"ways between obstacles that only Ipopt finds: {between}.")
    for name, life in numbers.get("lives", {}).items():
        if life["end"] - life["middle"] > _MEGABYTES or life["handles"] > 0:
            found.append(f"{name}: memory or open files grow: {life}.")
    for name, torment in numbers.get("kills", {}).items():
        if torment["different"] or torment["left"]:
            found.append(f"{name} does not go on as if nothing had happened: {torment}.")
    return found
