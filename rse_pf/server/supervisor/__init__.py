"""The server's main process: listener, worker processes, control port.

Processes and their life belong here; a robot's messages belong to `gateway`.
"""

from rse_pf.server.supervisor.supervisor import serve
from rse_pf.server.supervisor.worker_handle import warm_up

__all__ = ["serve", "warm_up"]
