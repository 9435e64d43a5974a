"""What docs/howto/browser_robot.md says of a first connection and of the certificate of the page."""

from __future__ import annotations

import runpy
import ssl
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rse_pf.local.lan.listener import LanListener
from tests.examples.conftest import ExamplePlatform
from tests.examples.conftest import platform as platform

REPOSITORY = Path(__file__).resolve().parents[2]
NODE = Path(sys.executable).with_name("node")


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.skipif(not NODE.exists(), reason="no Node: make setup installs it")
def test_a_wrong_token_and_a_platform_that_is_down_are_distinguished(platform: ExamplePlatform) -> None:
    module = (REPOSITORY / "client_web" / "rse-pf.js").as_uri()
    program = (
        f"import {{ connect }} from {module!r};"
        "for (const url of process.argv.slice(1)) await connect(url, { token: 'a.b.c' })"
        ".catch((error) => console.log(error.name, error.code, error.hint !== ''));"
    )
    addresses = [f"ws://127.0.0.1:{platform.cloud.port}/ws", "ws://127.0.0.1:1/ws"]

    done = subprocess.run(
        [str(NODE), "--input-type=module", "--eval", program, *addresses],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip

    assert done.stderr == ""
    assert done.stdout.splitlines() == ["RsePfError unauthorized true", "RsePfError connect true"]


def test_the_page_of_the_example_uses_the_certificate_of_the_platform(tmp_path: Path) -> None:
    LanListener(address="127.0.0.1", folder=tmp_path).prepare("test", now_s=time.time())
    serve = runpy.run_path(str(REPOSITORY / "examples" / "web" / "serve.py"))

    context = serve["certificate_of"](tmp_path)

    assert isinstance(context, ssl.SSLContext)
