"""What a setting consists of: default, unit, source, range and one line of help."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

__all__ = ["SettingRow", "setting"]

_OURS = "ours"


def setting(
    default: Any,
    *,
    doc: str,
    unit: str = "",
    source: str = _OURS,
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
) -> Any:
    """Declare one setting; the docs table, the CLI and the checks all come from here."""
    metadata = {
        "doc": doc, "unit": unit, "source": source, "low": low, "high": high, "choices": choices,
    }  # fmt: skip
    return field(default=default, metadata=metadata)


@dataclass(frozen=True, slots=True, kw_only=True)
class SettingRow:
    """One setting as a row of the documentation."""

    group: str
    name: str
    value: Any
    default: Any
    unit: str
    source: str
    doc: str
    low: float | None
    high: float | None
    choices: tuple[str, ...]
