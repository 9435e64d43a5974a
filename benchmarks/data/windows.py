"""Figures of a time window: shared by the benchmarks that load a platform and inject faults."""

from __future__ import annotations

from typing import Any

from benchmarks.frame.statistics import percentile
from rse_pf.experiments.results.records import CommandRecord


def poses(commands: list[CommandRecord], begin_s: float, end_s: float) -> dict[str, Any]:
    """Return latencies and unanswered frames of poses planned from *begin_s* to *end_s*."""
    chosen = [command for command in commands if begin_s <= command.planned < end_s]
    took = [
        (command.answered - command.planned) * 1e3
        for command in chosen
        if command.answered is not None and command.code == "ok"
    ]
    p50, p99 = percentile(took, [50, 99])
    return {"n": len(chosen), "unanswered": len(chosen) - len(took), "p50_ms": p50, "p99_ms": p99}
