"""The driver of the JavaScript client in Chromium: ``web_chromium.py [--worker] SCENARIO``, or ``--claims``.

The page and its modules come from a small server at the origin ``RSE_PF_ORIGIN``: for Chromium, a page that
playwright answers by itself is not on this machine, and may not connect to it.
"""

from __future__ import annotations

import asyncio
import http.server
import json
import os
import shutil
import sys
import threading
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

HERE = Path(__file__).resolve().parent
REPOSITORY = HERE.parents[2]
FILES = {
    "/rse-pf.js": REPOSITORY / "client_web" / "rse-pf.js",
    "/web_scenarios.mjs": HERE / "web_scenarios.mjs",
}
CLAIMS = (
    "golden", "pnp", "typed-error", "undecodable", "busy", "deadline", "newest", "stream", "renew", "expired",
    "revoked", "updates", "progress", "data",
)  # fmt: skip

RUN = """
async ({ scenario, options }, { say, nextOrder }) => {
  const module = await import("/rse-pf.js");
  const { run } = await import("/web_scenarios.mjs");
  async function* orders() {
    for (let order; (order = await nextOrder()); ) yield order;
  }
  return run(scenario, { ...options, module, say, orders: orders() });
}
"""
PAGE = (
    f"""(job) => ({RUN})(job, {{ say: (event) => window.say(event), nextOrder: () => window.nextOrder() }})"""
)
WORKER_SCRIPT = f"""
const waiting = [], told = [];
onmessage = async ({{ data }}) => {{
  if (data.job) postMessage({{ code: await ({RUN})(data.job, {{ say, nextOrder }}) }});
  else if (waiting.length) waiting.shift()(data.order);
  else told.push(data.order);
}};
const say = (event) => postMessage({{ event }});
const nextOrder = () => told.length ? told.shift() : new Promise((resolve) => waiting.push(resolve));
"""
IN_WORKER = """
(job) => new Promise((resolve) => {
  const worker = new Worker("/worker.js", { type: "module" });
  worker.onmessage = ({ data }) => ("code" in data ? resolve(data.code) : window.say(data.event));
  worker.onerror = (event) => {
    window.say({ event: "error", message: "worker: " + event.message });
    resolve(1);
  };
  worker.postMessage({ job });
  (async () => {
    for (let order; (order = await window.nextOrder()); ) worker.postMessage({ order });
  })();
})
"""


def say(event: Any) -> None:
    """Write one event."""
    sys.stdout.write(json.dumps(event) + "\n")
    sys.stdout.flush()


def chromium() -> str:
    """Return the path of a Chromium."""
    found = next(filter(None, map(shutil.which, ("chromium-headless-shell", "chromium"))), None)
    if found is None:
        raise SystemExit("no Chromium: sudo apt-get install chromium-headless-shell")
    return found


def inputs() -> dict[str, Any]:
    """Return what the page needs of the environment."""
    env = os.environ
    given: dict[str, Any] = {}
    if "RSE_PF_INPUT" in env:
        given["input"] = json.loads(Path(env["RSE_PF_INPUT"]).read_text("utf-8"))
        given["messages"] = json.loads(Path(given["input"]["golden"]).read_text("utf-8"))
    names = {"url": "URL", "token": "TOKEN", "dataUrl": "DATA_URL", "map": "MAP", "codec": "CODEC"}
    given |= {name: env[f"RSE_PF_{word}"] for name, word in names.items() if f"RSE_PF_{word}" in env}
    return {**given, "seconds": float(env.get("RSE_PF_SECONDS", "2"))}


class Files(http.server.BaseHTTPRequestHandler):
    """The page, its modules, and the script of the worker."""

    def do_GET(self) -> None:
        kind, body = "text/javascript", b""
        if self.path == "/":
            kind, body = "text/html", b"<!doctype html><title>robot</title>"
        elif self.path == "/worker.js":
            body = WORKER_SCRIPT.encode()
        elif self.path in FILES:
            body = FILES[self.path].read_bytes()
        self.send_response(200 if body else 404)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Write nothing."""


async def main(scenario: str, is_worker: bool) -> int:
    """Run one scenario in a page, or in a worker of it."""
    from playwright.async_api import async_playwright

    loop = asyncio.get_running_loop()
    lines = asyncio.StreamReader()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(lines), sys.stdin)

    async def next_order() -> Any:
        line = await lines.readline()
        return json.loads(line) if line else None

    origin = os.environ["RSE_PF_ORIGIN"]
    server = http.server.ThreadingHTTPServer(("127.0.0.1", urlsplit(origin).port or 0), Files)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=chromium(), args=["--no-sandbox"])
        page = await browser.new_page()
        page.on("pageerror", lambda error: say({"event": "error", "message": f"page: {error}"}))
        await page.expose_function("say", say)
        await page.expose_function("nextOrder", next_order)
        await page.goto(f"{origin}/")
        code = await page.evaluate(
            IN_WORKER if is_worker else PAGE, {"scenario": scenario, "options": inputs()}
        )
        await browser.close()
    return int(code)


if __name__ == "__main__":
    words = sys.argv[1:]
    if "--claims" in words:
        say(list(CLAIMS))
        sys.exit(0)
    if words[-1] not in CLAIMS:
        say({"event": "unsupported"})
        sys.exit(3)
    sys.exit(asyncio.run(main(words[-1], "--worker" in words)))
