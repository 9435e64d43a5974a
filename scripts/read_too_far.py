"""Let the native core read beyond an array, which a sanitizer must report; scripts/sanitize.sh runs this
script."""

from __future__ import annotations

import sys

import numpy as np

from rse_pf.native import find_library
from rse_pf.pnp import PnpOptions, WeakLimits
from rse_pf.pnp.engines import native_options
from rse_pf.pnp.native_solver import open_solver
from rse_pf.pnp.problems import make_problem


def main() -> None:
    """Print the path of the loaded library, then solve with one row more than the array of points has."""
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
