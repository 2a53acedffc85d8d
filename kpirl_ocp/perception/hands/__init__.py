"""Hands and their landmarks in images.

Names are imported when they are used, because they need OpenCV and the extra `hands`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
