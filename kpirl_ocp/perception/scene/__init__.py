"""The scene in PyBullet: robot, bottle, shelf, hand and camera.

Names are imported when they are used, because they need different packages.
"""

import lazy_loader

from kpirl_ocp.errors import naming_extras

_imported, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__ = naming_extras(_imported)
