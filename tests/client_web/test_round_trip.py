"""The round trip of a PnP command in Chromium, over loopback and without a load balancer: at most 12 ms."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from tests.examples.conftest import ExamplePlatform
from tests.examples.conftest import platform as platform
from tests.wire.golden import regenerate

pytest.importorskip("playwright", reason="no playwright: make browser installs it")
pytestmark = [pytest.mark.slow, pytest.mark.system, pytest.mark.timeout(300)]

DRIVER = Path(__file__).resolve().parents[1] / "clients" / "drivers" / "web_chromium.py"
GOLDEN = Path(regenerate.__file__).parent
SECONDS = 15
MAX_P50_MS = 12.0
with socket.create_server(("127.0.0.1", 0)) as _free:
    ALLOWED_ORIGINS = f"http://127.0.0.1:{_free.getsockname()[1]}"


@pytest.mark.parametrize("codec", ["json+zlib", "json"])
def test_a_pose_takes_at_most_12_ms(platform: ExamplePlatform, codec: str, tmp_path: Path) -> None:
    poses = json.loads((GOLDEN / "poses.json").read_text(encoding="utf-8"))
    payload = poses["200 points, 30 % wrong"]["command"]["payload"]
    given = tmp_path / "input.json"
    command = {"service": "pnp", "payload": {**payload, "options": None}}
    given.write_text(json.dumps({"commands": [command], "golden": str(GOLDEN / "messages.json")}))
    env = {
        "RSE_PF_URL": f"ws://127.0.0.1:{platform.cloud.servers[0].port}/ws", "RSE_PF_CODEC": codec,
        "RSE_PF_TOKEN": platform.cloud.issue_token("browser", None), "RSE_PF_INPUT": str(given),
        "RSE_PF_SECONDS": str(SECONDS), "RSE_PF_ORIGIN": ALLOWED_ORIGINS,
    }  # fmt: skip

    done = subprocess.run(
        [sys.executable, str(DRIVER), "round-trips"], env={**os.environ, **env}, stdin=subprocess.PIPE,
        capture_output=True, text=True, timeout=SECONDS + 90, check=False,
    )  # fmt: skip

    figures = json.loads(done.stdout.splitlines()[-1])
    print(codec, f"load {os.getloadavg()[0]:.1f}", figures)
    assert figures["event"] == "done"
    assert figures["codes"] == {"ok": figures["sent"]}
    assert figures["p50_ms"] <= MAX_P50_MS
