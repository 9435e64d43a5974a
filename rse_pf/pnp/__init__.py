"""Perspective-n-point: problems, engines and the solver with its evidence."""

from rse_pf.pnp.engines import available_engines
from rse_pf.pnp.options import PnpOptions, WeakLimits
from rse_pf.pnp.solver import PnpSolution, solve_pnp

__all__ = ["PnpOptions", "PnpSolution", "WeakLimits", "available_engines", "solve_pnp"]
