"""Know the names of 0.1.0 that changed: an old one is refused, and the hint says the new one."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

__all__ = ["RENAMED_FILE", "hint_for_old_option", "hint_for_old_setting"]

RENAMED_FILE = Path(__file__).with_name("renamed.json")
"""Old name -> new name, by kind; null means that it is gone."""


def hint_for_old_setting(name: str) -> str:
    """Return what to write in place of *name*, a group or setting of 0.1.0; empty if it never was one."""
    if name == "prices":
        return "prices are in a file now: remove the group, and use rse-pf cloud cost --prices FILE"
    settings = _table()["settings"]
    if name not in settings:
        return ""
    new = settings[name]
    return f"{name} was renamed: write {new}" if new else f"{name} is a constant now: remove the line"


def hint_for_old_option(name: str) -> str:
    """Return what to write in place of *name*, an option of 0.1.0; empty if it never was one."""
    new = _table()["options"].get(name)
    return f"{name} was renamed: write {new}" if new else ""


@functools.cache
def _table() -> dict[str, dict[str, Any]]:
    table: dict[str, dict[str, Any]] = json.loads(RENAMED_FILE.read_text(encoding="utf-8"))
    return table
