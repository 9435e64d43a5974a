"""Let the native core read behind an array, which a sanitizer must notice; scripts/sanitize.sh runs it."""

from __future__ import annotations

import sys

import numpy as np

from rse_pf.native import find_library
from rse_pf.pnp import PnpOptions, WeakLimits
from rse_pf.pnp.engines import native_options
from rse_pf.pnp.native_solver import open_solver
from rse_pf.pnp.problems import make_problem


def main() -> None:
    """Say which library is loaded, then solve with one row more than the points have."""
    path = find_library()
    assert path is not None
    sys.stdout.write(f"{path}\n")
    problem = make_problem(seed=1)
    short = problem.points_world[:-1].copy()
    points = np.lib.stride_tricks.as_strided(short, shape=problem.points_world.shape)
    options = native_options(PnpOptions(), WeakLimits())
    open_solver(path).evaluate(points, problem.pixels, problem.camera, options)


if __name__ == "__main__":
    main()
