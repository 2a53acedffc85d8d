"""Data sets of others: LeRobot (in and out), robomimic, CSV and plain arrays, all as takes; extra `data`.

Names are imported when they are used, because they need different packages.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
