"""A browser connects by WSS from an https page: headless Chromium, on this machine and on another one.

The authority is trusted by the browser's NSS database (certutil -A), as a person would import it; no switch
turns the check of certificates off.
"""

from __future__ import annotations

import asyncio
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from system.local.lan.conftest import OtherMachine

from rse_pf.config import PlatformSettings
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.local.lan.listener import authority_file

pytestmark = [pytest.mark.system, pytest.mark.slow]

SOON_S = 90.0
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
CERTUTIL = shutil.which("certutil")


VISIT = r"""
import asyncio, json, re, subprocess, sys
import websockets

SAID = '''new Promise(done => {
  const socket = new WebSocket("wss://" + location.host + "/ws", ["rse-pf.v1.json", "rse-pf.token." + TOKEN]);
  socket.onopen = () => socket.send(JSON.stringify({type: "hello"}));
  socket.onmessage = event => {
    const message = JSON.parse(event.data);
    done(message.type + " by " + message.server + " as " + message.robot);
  };
  socket.onclose = () => done("refused");
})'''

async def visit(url, token, debugger):
    async with websockets.connect(debugger, max_size=None) as tool:
        async def ask(method, session="", **parameters):
            order = {"id": 1, "method": method, "params": parameters}
            await tool.send(json.dumps({**order, "sessionId": session} if session else order))
            while "id" not in (told := json.loads(await tool.recv())):
                pass
            return told.get("result", told)

        target = await ask("Target.createTarget", url="about:blank")
        attached = await ask("Target.attachToTarget", targetId=target["targetId"], flatten=True)
        session = attached["sessionId"]
        await ask("Page.enable", session)
        opened = await ask("Page.navigate", session, url=url)
        if opened.get("errorText"):
            return opened["errorText"]
        while json.loads(await tool.recv()).get("method") != "Page.loadEventFired":
            pass
        connect = SAID.replace("TOKEN", json.dumps(token))
        said = await ask("Runtime.evaluate", session, expression=connect, awaitPromise=True)
        return said["result"]["value"]

browser = subprocess.Popen(sys.argv[3:], stderr=subprocess.PIPE, text=True)
try:
    debugger = next(found[0] for line in browser.stderr if (found := re.search(r"ws://\S+", line)))
    print(asyncio.run(asyncio.wait_for(visit(sys.argv[1], sys.argv[2], debugger), 60)))
finally:
    browser.kill()
    browser.communicate()
"""
"""Opens a page in Chromium by its debugging protocol, and connects from it.

It prints what the platform says, or why the page is not shown."""


class Browser:
    """Headless Chromium with a home of its own."""

    def __init__(self, home: Path, other: OtherMachine) -> None:
        self._home = home
        self._other = other

    def trust(self, authority: Path) -> None:
        """Import the authority as one for web sites."""
        database = self._home / ".pki" / "nssdb"
        database.mkdir(parents=True, exist_ok=True)
        for words in (["-N", "--empty-password"], ["-A", "-t", "C,,", "-n", "rse-pf", "-i", str(authority)]):
            subprocess.run([str(CERTUTIL), "-d", f"sql:{database}", *words], check=True, timeout=SOON_S)

    def visit(self, url: str, token: str) -> str:
        """Return what a page at *url* is told with *token*, or the browser's error, on the other machine."""
        done = self._other.run(
            "env", f"HOME={self._home}", sys.executable, "-c", VISIT, url, token, str(CHROMIUM), "--headless",
            "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
            f"--user-data-dir={self._home / 'profile'}", "--remote-debugging-port=0", "about:blank",
            within_s=SOON_S,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()


@pytest.fixture
def browser(tmp_path: Path, other_machine: OtherMachine) -> Iterator[Browser]:
    if CHROMIUM is None or CERTUTIL is None:
        pytest.skip("needs chromium and certutil (Debian: chromium, libnss3-tools)")
    home = tmp_path / "home"
    home.mkdir()
    return Browser(home, other_machine)


async def test_a_page_over_https_connects_with_a_token_and_only_if_the_authority_is_trusted(
    browser: Browser, other_machine: OtherMachine, tmp_path: Path
) -> None:
    folder = tmp_path / "platform"

    async with LocalPlatform(
        PlatformSettings(), state=folder, servers=1, port=0, data=False, lan=other_machine.here
    ) as platform:
        page = platform.url.replace("wss:", "https:").removesuffix("ws") + "healthz"
        token = platform.issue_token("browser-1")
        untrusted = await asyncio.to_thread(browser.visit, page, token)
        browser.trust(authority_file(folder))
        connected = await asyncio.to_thread(browser.visit, page, token)
        refused = await asyncio.to_thread(browser.visit, page, f"{token[:-4]}AAAA")

    assert connected == "welcome by server-1 as browser-1"
    assert refused == "refused"
    assert untrusted == "net::ERR_CERT_AUTHORITY_INVALID"
