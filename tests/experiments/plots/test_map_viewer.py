"""A map in the browser, with a stand-in for viser: what is drawn, where it listens, and that it ends."""

from __future__ import annotations

import sys
import threading
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rse_pf.errors import MissingExtra, UsageError
from rse_pf.experiments.plots.map_viewer import browse_map
from rse_pf.maps.format import MapVersion
from rse_pf.services.synthetic_maps import make_world


class Page:
    """Remembers what was drawn."""

    def __init__(self, host: str, port: int, verbose: bool) -> None:
        self.host, self.port, self.stopped = host, port, False
        self.calls: list[tuple[str, tuple[Any, ...], dict[str, Any]]] = []
        self.scene = self

    def __getattr__(self, name: str) -> Any:
        return lambda *words, **options: self.calls.append((name, words, options))

    def get_port(self) -> int:
        return self.port

    def stop(self) -> None:
        self.stopped = True


def browse(version: MapVersion) -> tuple[Page, list[str]]:
    pages: list[Page] = []
    said: list[str] = []
    over = threading.Event()
    over.set()

    def make(**options: Any) -> Page:
        pages.append(Page(**options))
        return pages[-1]

    browse_map(version, 8080, said.append, over, viser=SimpleNamespace(ViserServer=make))
    return pages[0], said


def test_shows_the_cloud_and_a_camera_for_each_keyframe_and_ends() -> None:
    a, _ = make_world(1).walk("a", np.linspace(0.0, 0.2, 3), seed=1)
    points = np.zeros((5, 3), np.float32)
    page, said = browse(MapVersion(keyframes=a.keyframes, points=points, colours=np.zeros((5, 3), np.uint8)))

    cameras = [words for name, words, _ in page.calls if name == "add_camera_frustum"]
    assert cameras == [("/a/0",), ("/a/1",), ("/a/2",)]
    (cloud,) = [options for name, _, options in page.calls if name == "add_point_cloud"]
    assert len(cloud["points"]) == 5
    assert page.host == "127.0.0.1"
    assert said == [f"http://{page.host}:{page.port}"]
    assert page.stopped


def test_without_viser_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)

    with pytest.raises(MissingExtra) as raised:
        browse_map(MapVersion(keyframes=()), 8080, print, threading.Event())

    assert "rse-pf[view]" in (raised.value.hint or "")


def test_a_number_that_is_no_port_is_refused() -> None:
    with pytest.raises(UsageError, match="port 70000"):
        browse_map(MapVersion(keyframes=()), 70000, print, threading.Event())
