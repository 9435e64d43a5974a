"""The main process of a server: it accepts sockets, controls the workers, and answers the control port.

The start, replacement and exit of processes belong to this package; messages of robots belong to `gateway`.
"""

from rse_pf.server.supervisor.supervisor import serve
from rse_pf.server.supervisor.worker_handle import warm_up

__all__ = ["serve", "warm_up"]
