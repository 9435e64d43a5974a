"""The SDK without the native core can be imported; features and poses name the package that they need."""

from __future__ import annotations

import subprocess
import sys

ASK_FOR_FEATURES_AND_A_POSE = """
import numpy as np
from rse_pf import native
native.find_library = lambda: None
import client_sdk
from client_sdk.point_map import PointMap
from rse_pf.errors import MissingExtra
from rse_pf.pnp import solve_pnp
from rse_pf.pnp.problems import KINECT
from rse_pf.slam.orb import describe_orb
from rse_pf.slam.stereo import disparities
gray = np.zeros((60, 80), np.uint8)
for work in (
    lambda: describe_orb(np.zeros((60, 80, 3), np.uint8), 9),
    lambda: disparities(gray, gray, np.zeros((1, 2))),
    lambda: solve_pnp(np.ones((4, 3)), np.ones((4, 2)), KINECT),
    lambda: PointMap().add_points(np.ones((1, 3)), np.ones((1, 3), np.uint8)),
):
    try:
        work()
    except MissingExtra as error:
        print(error.message, "|", error.hint)
"""


def test_each_use_of_a_missing_core_names_the_command_that_brings_it() -> None:
    done = subprocess.run(
        [sys.executable, "-c", ASK_FOR_FEATURES_AND_A_POSE], capture_output=True, text=True, check=False
    )

    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == 4
    assert set(lines) == {lines[0]}
    assert "native core" in lines[0]
    assert "make native" in lines[0]
    assert "pip install" in lines[0]
