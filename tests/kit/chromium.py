"""Debian's Chromium without a window, which playwright drives."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

__all__ = ["chromium", "film_as_camera"]


@contextmanager
def chromium(*args: str) -> Iterator[Any]:
    """A browser that was started with *args*; skips the test where there is none."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="no playwright: make browser installs it")
    path = next(filter(None, map(shutil.which, ("chromium-headless-shell", "chromium"))), None)
    if path is None:
        pytest.skip("no Chromium: sudo apt-get install chromium-headless-shell")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox", *args])
        yield browser
        browser.close()


def film_as_camera(film: Path) -> tuple[str, ...]:
    """Return what lets Chromium read a film in the place of its camera, and ask nobody for leave."""
    return (
        "--use-fake-ui-for-media-stream",
        "--use-fake-device-for-media-stream",
        f"--use-file-for-fake-video-capture={film}",
    )
