"""Dynamics learned in keypoints: network, training and evaluation.

Names are imported when they are used, because they need different packages.
"""

from typing import Any

import lazy_loader

from kpirl_ocp.errors import DependencyError

_imported, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    try:
        return _imported(name)
    except ModuleNotFoundError as error:
        if error.name not in ("torch", "cv2"):
            raise
        raise DependencyError.of(name, error, "perception") from error
