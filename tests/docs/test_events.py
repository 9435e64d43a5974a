"""The page of events explains every kind of event."""

from __future__ import annotations

from pathlib import Path

from rse_pf.local.events import EVENTS


def test_every_kind_of_event_is_explained(repository: Path) -> None:
    page = (repository / "docs" / "events.md").read_text(encoding="utf-8")

    assert [name for name in EVENTS if f"`{name}`" not in page] == []
