"""The heaviest example: two robots map, share, and merge, on a platform with its data service."""

from __future__ import annotations

import re

import pytest

from client_sdk.point_map import read_ply
from tests.examples.conftest import ExamplePlatform

for _package in ("cv2", "gtsam"):
    pytest.importorskip(_package, reason="pip install 'rse-pf[vision,maps]'")
from tests.kit.rendered_inputs import write_drives  # noqa: E402  after importorskip

pytestmark = [pytest.mark.system, pytest.mark.slow]
HAS_DATA = True


def test_two_robots_make_one_map(platform: ExamplePlatform) -> None:
    drives = [platform.folder / name for name in ("drive-1", "drive-2")]
    write_drives(drives, frames=16)

    done = platform.run(platform.command("two_robots_one_map"))

    assert (done.returncode, done.stderr) == (0, "")
    assert re.search(r"^2 maps joined, [1-9]\d* links: \d{4,} points", done.stdout, re.MULTILINE), done.stdout
    assert len(read_ply(platform.folder / "merged.ply")[0]) > 1000
