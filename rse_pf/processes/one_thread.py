"""Environment variables with which BLAS uses one thread, so that results are equal in every process.

If BLAS computes a product of large matrices by several threads, the sums are formed in another order than by
one thread, so the results differ in their last bits.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

__all__ = ["ONE_THREAD"]

ONE_THREAD: Mapping[str, str] = MappingProxyType(
    dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
)
"""The environment variables; they have an effect only if they are set before numpy is imported."""
