"""Perspective-n-point: problems, engines and the solver with its evidence."""

from rse_pf.pnp.engines import available_engines
from rse_pf.pnp.solver import PnpOptions, PnpSolution, WeakLimits, solve_pnp

__all__ = ["PnpOptions", "PnpSolution", "WeakLimits", "available_engines", "solve_pnp"]
