"""A backend server: `serve` is the whole of it; the files beside it are its parts."""

from rse_pf.backend.supervisor import serve

__all__ = ["serve"]
