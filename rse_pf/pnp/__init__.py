"""Perspective-n-point: problems, engines, and the solver with its evidence.

Estimating one camera pose belongs here; the messages of the service ``pnp`` belong to `rse_pf.services`.
"""

from rse_pf.pnp.depth_refinement import DepthNoise, refine_with_depth
from rse_pf.pnp.engines import available_engines
from rse_pf.pnp.options import PnpOptions, WeakLimits
from rse_pf.pnp.solver import PnpSolution, solve_pnp

__all__ = [
    "DepthNoise",
    "PnpOptions",
    "PnpSolution",
    "WeakLimits",
    "available_engines",
    "refine_with_depth",
    "solve_pnp",
]
