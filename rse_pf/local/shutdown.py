"""End a local platform from outside its control plane, also one whose control plane was killed.

Only processes whose id and start time are in the state file are signalled, and none of them is left.
"""

from __future__ import annotations

import signal
from pathlib import Path

from rse_pf.local.processes import STOP_TIMEOUT_S, is_alive, send_signal, wait_ended
from rse_pf.local.state import read_state, remove_state

__all__ = ["stop_platform"]


def stop_platform(folder: Path, timeout_s: float = STOP_TIMEOUT_S) -> bool:
    """End the platform in *folder*, waiting *timeout_s* for each step; return whether anything ran.

    The control plane is asked first and ends its servers itself; then whatever is left is ended here.

    Raises:
        ConfigurationError: The state file is there, but is not readable.
    """
    state = read_state(folder)
    if state is None:
        return False
    ran = send_signal(state.control_plane, signal.SIGTERM)
    # It gives servers and balancer their time, one after the other.
    if ran and not wait_ended(state.control_plane, 3 * timeout_s):
        send_signal(state.control_plane, signal.SIGKILL)
        wait_ended(state.control_plane, timeout_s)
    latest = read_state(folder) or state
    left = [mark for mark in latest.processes() if is_alive(mark)]
    for mark in left:
        send_signal(mark, signal.SIGINT)
    for mark in left:
        if not wait_ended(mark, timeout_s):
            send_signal(mark, signal.SIGKILL)
            wait_ended(mark, timeout_s)
    remove_state(folder)
    return ran or bool(left)
