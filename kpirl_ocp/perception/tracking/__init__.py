"""Points on an object in real video: chosen, followed, drawn, and judged as a demonstration.

Names are imported when they are used, because they need OpenCV.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
