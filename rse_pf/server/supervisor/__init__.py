"""The main process of a server: listener, worker processes and control port.

The start, replacement and end of processes belong here; messages of robots belong to `gateway`.
"""

from rse_pf.server.supervisor.supervisor import serve
from rse_pf.server.supervisor.worker_handle import warm_up

__all__ = ["serve", "warm_up"]
