"""Learn a cost over keypoints from demonstrations, and plan with it.

    outer (IRL):   min_psi  L(tau(psi), tau_demo)
    inner (OCP):   tau(psi) = argmin_u  C_psi(rollout(s0, u, f), z_goal)

State a problem with `OCP`, solve it with a solver, differentiate through it with a hypergradient, learn with `learn`.
Robots, networks and keypoint costs are in `kpirl_ocp.ocp.models`. Names are imported when they are used.
"""

import lazy_loader

from kpirl_ocp.version import __version__ as __version__

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
