"""The examples of live maps: two robots, one after the other, in one map."""

from __future__ import annotations

import re

import pytest

from tests.examples.conftest import ExamplePlatform

pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")
from tests.examples.rendered_inputs import write_drives

pytestmark = [pytest.mark.system, pytest.mark.slow]
HAS_DATA = True


def test_two_robots_share_a_live_map(platform: ExamplePlatform) -> None:
    drives = [platform.folder / name for name in ("drive-1", "drive-2")]
    write_drives(drives, frames=16)
    for kind in ("rgb", "depth"):
        lines = [f"{row / 10:.1f} {kind}/{row}.png\n" for row in range(16)]
        (drives[0] / f"{kind}.txt").write_text("".join(lines))

    first = platform.run(platform.command("live_map_recording"))
    second = platform.run(platform.command("live_map_camera"))

    assert (first.returncode, first.stderr) == (0, "")
    assert re.search(r"^16 frames, [1-9]\d* keyframes, 0 waiting$", first.stdout, re.MULTILINE), first.stdout
    assert (second.returncode, second.stderr) == (0, "")
    assert second.stdout.count("\n") >= 16
