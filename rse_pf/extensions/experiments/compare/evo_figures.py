"""The ATE that the program evo computes, if evo is installed, as a check of our own ATE.

evo is GPL-3 software: it is never imported, but run as the command ``evo_ape`` with trajectory files.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from client_sdk.trajectory import write_trajectory
from client_sdk.trajectory_error import Accuracy

__all__ = ["evo_ate_cm", "evo_command"]

# The program of evo that computes the ATE.
_COMMAND = "evo_ape"
# The line of evo's output with the root mean square error.
_RMSE = re.compile(r"^\s*rmse\s+([0-9.eE+-]+)\s*$", re.MULTILINE)
# Time limit of one run of evo, in seconds.
_EVO_TIMEOUT_S = 60.0
# Largest difference, in seconds, of two time stamps that evo takes for equal; both files that we write have
# equal stamps.
_EQUAL_STAMPS_S = "0.001"


def evo_command() -> str | None:
    """Return the path of ``evo_ape`` in the folder of this interpreter or on PATH.

    None if evo is not installed.
    """
    installed = Path(sys.executable).with_name(_COMMAND)
    return str(installed) if installed.is_file() else shutil.which(_COMMAND)


def evo_ate_cm(command: str, errors: Accuracy) -> float | None:
    """Return the ATE (rmse, cm) that evo computes of the trajectories in *errors*, with evo's own alignment.

    None if evo fails, or takes longer than 60 s.
    """
    with tempfile.TemporaryDirectory() as name:
        truth, estimate = Path(name) / "truth.txt", Path(name) / "estimate.txt"
        write_trajectory(truth, errors.truth)
        write_trajectory(estimate, errors.compared)
        words = [command, "tum", str(truth), str(estimate), "--align", "--t_max_diff", _EQUAL_STAMPS_S]
        words += [] if errors.has_unit else ["--correct_scale"]
        try:
            done = subprocess.run(words, capture_output=True, text=True, timeout=_EVO_TIMEOUT_S, check=False)
        except (OSError, subprocess.TimeoutExpired):
            return None
    found = _RMSE.search(done.stdout)
    return None if done.returncode != 0 or found is None else 100 * float(found[1])
