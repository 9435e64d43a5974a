"""A map server without gtsam says so in one line when it takes its map."""

from __future__ import annotations

import importlib.util
from typing import Any

import pytest

from rse_pf.local.events import event_sentence
from rse_pf.server.live_map.map_server.process import warn_without_optimiser


class Log:
    def __init__(self) -> None:
        self.lines: list[dict[str, Any]] = []

    def warning(self, event: str, **fields: Any) -> None:
        self.lines.append({"event": event, **fields})


def logged(monkeypatch: pytest.MonkeyPatch, *, has_gtsam: bool) -> list[str]:
    found = object() if has_gtsam else None
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: found if name == "gtsam" else object())
    log: Any = Log()
    warn_without_optimiser(log, "hall")
    return [event_sentence(line) for line in log.lines]


def test_the_line_names_the_map_and_the_command_that_helps(monkeypatch: pytest.MonkeyPatch) -> None:
    (line,) = logged(monkeypatch, has_gtsam=False)

    assert line.startswith("the live map hall is less accurate than it could be: gtsam is not installed")
    assert line.endswith("pip install 'rse-pf[maps]'")


def test_with_gtsam_nothing_is_logged(monkeypatch: pytest.MonkeyPatch) -> None:
    assert logged(monkeypatch, has_gtsam=True) == []
