"""The perspective-n-point problem: estimate a camera pose from 3-D to 2-D matches, some of them wrong.

`solver` is the entry point; it calls one of two `engines`, of which `native_solver` is the native core.
`rules` lists why a pose is weak or refused, `depth_refinement` refines a pose with measured depths, and
`problems` makes test data.  The messages of the service ``pnp`` are in `rse_pf.services.pnp`.
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
