"""Ways to and from what others use: PyTorch and JAX.

Names are imported when they are used, because they need different packages.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
