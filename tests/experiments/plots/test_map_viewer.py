"""A map in the browser, with a stand-in for viser: what is drawn, where it listens, and that it ends."""

from __future__ import annotations

import dataclasses
import sys
import threading
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rse_pf.errors import MissingExtra, UsageError
from rse_pf.experiments.plots.map_viewer import browse_map, first_view
from rse_pf.maps.format import MapVersion
from tests.synthetic_maps import make_world


class Page:
    """Remembers what was drawn."""

    def __init__(self, host: str, port: int, verbose: bool) -> None:
        self.host, self.port, self.stopped = host, port, False
        self.calls: list[tuple[str, tuple[Any, ...], dict[str, Any]]] = []
        self.scene = self
        self.initial_camera = SimpleNamespace()

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


def room() -> MapVersion:
    """A room of 6 x 3 x 8 m with a camera that looks along +z of a world whose down is +y, and an outlier."""
    a, _ = make_world(1).walk("a", np.linspace(0.0, 0.2, 3), seed=1)
    turned = [dataclasses.replace(each, T_world_camera=np.eye(4)) for each in a.keyframes]
    points = np.random.default_rng(1).uniform([-3, -2, 0], [3, 1, 8], (4000, 3)).astype(np.float32)
    points[0] = 500.0
    return MapVersion(keyframes=tuple(turned), points=points, colours=np.zeros((4000, 3), np.uint8))


def test_the_first_view_is_upright_outside_of_the_cloud_and_above_it() -> None:
    version = room()
    position, look_at, up = first_view(version)

    np.testing.assert_allclose(up, [0, -1, 0], atol=1e-9)
    np.testing.assert_allclose(look_at, [0, -0.5, 4], atol=0.2)
    assert (position - look_at) @ up > 2.0, "above"
    assert position[2] < 0.0, "on the side from which the camera looks into the room"
    assert np.all(np.linalg.norm(version.points[1:] - position, axis=1) > 1.0)
    towards = (look_at - position) / np.linalg.norm(look_at - position)
    inside = (version.points[1:] - position) @ towards / np.linalg.norm(version.points[1:] - position, axis=1)
    assert np.mean(inside > np.cos(np.deg2rad(75 / 2))) > 0.95


@pytest.mark.parametrize("points", [np.zeros((0, 3), np.float32), np.zeros((1, 3), np.float32)])
def test_a_map_of_nothing_has_a_first_view_too(points: Any) -> None:
    for keyframes in ((), room().keyframes):
        made = MapVersion(keyframes=keyframes, points=points, colours=np.zeros(points.shape, np.uint8))
        assert all(np.all(np.isfinite(each)) for each in first_view(made))


def test_the_page_opens_with_the_first_view() -> None:
    page, _ = browse(room())

    assert page.initial_camera.up == pytest.approx((0.0, -1.0, 0.0))
    assert page.initial_camera.position == pytest.approx(tuple(first_view(room())[0]))
    assert page.initial_camera.look_at == pytest.approx(tuple(first_view(room())[1]))
    assert ("set_up_direction", (page.initial_camera.up,), {}) in page.calls
