"""The environment of a process whose numbers must be the same in every process: one thread of BLAS.

A product of large matrices that BLAS shares among threads is summed in another order, and differs in the last
bits from that of one thread.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

__all__ = ["ONE_THREAD"]

ONE_THREAD: Mapping[str, str] = MappingProxyType(
    dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
)
"""Environment variables; they count only if they are set before numpy is imported."""
