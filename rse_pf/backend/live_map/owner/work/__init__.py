"""The parts of an owner that work beside its requests: threads, the log's writer, links and versions."""

from __future__ import annotations

__all__: list[str] = []
