"""A backend server: `serve` is the whole of it; the files beside it are its parts."""

from rse_pf.backend.supervisor import serve
from rse_pf.backend.worker_process import warm_up

__all__ = ["serve", "warm_up"]
