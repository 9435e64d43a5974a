"""The page at ``/`` of a platform that other machines may reach: it tests whether a browser can connect.

One static text without any outside request.  The token stays in the browser: it is typed, or stands behind
the ``#`` of the address, which no browser sends.
"""

from __future__ import annotations

import base64
import hashlib
import json

__all__ = ["connect_page", "page_headers"]

_SCRIPT = """
const form = document.forms[0], said = document.querySelector("output");
const camera = navigator.mediaDevices ? "this page may ask for the camera" : "no camera from this page";
function test(token) {
  said.textContent = "connecting";
  const url = "wss://" + location.host + document.documentElement.dataset.path;
  const socket = new WebSocket(url, ["rse-pf.v1.json", "rse-pf.token." + token]);
  let isWelcome = false;
  socket.onopen = () => socket.send(JSON.stringify({type: "hello"}));
  socket.onmessage = event => {
    const message = JSON.parse(event.data);
    isWelcome = message.type === "welcome";
    said.textContent = isWelcome
      ? "connected to " + message.server + " as " + message.robot + "; " + camera
      : "refused: " + message.message;
    socket.close();
  };
  socket.onclose = () => {
    if (!isWelcome) said.textContent = "refused: the token is wrong or expired, or no server is ready";
  };
}
form.onsubmit = event => { event.preventDefault(); test(form.token.value.trim()); };
if (location.hash.startsWith("#token=")) test(location.hash.slice(7));
"""

_STYLE = """
body { font: 1rem/1.5 system-ui, sans-serif; max-width: 40rem; margin: 2rem auto; padding: 0 1rem; }
input { width: 100%; box-sizing: border-box; }
"""

_PAGE = """<!doctype html>
<html lang="en" data-path={path}>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>RSE-PF</title>
<style>{style}</style>
<h1>RSE-PF</h1>
<p>This is a platform for robots. To test the connection of this browser, enter a token of
<code>rse-pf token issue NAME</code>.</p>
<form><label>Token <input name="token" autocomplete="off" required></label> <button>Connect</button></form>
<p><output>not connected</output></p>
<script>{script}</script>
</html>
"""


def connect_page(path: str) -> str:
    """Return the page; *path* is that of the robots' WebSocket."""
    quoted = json.dumps(path).replace("&", "&amp;").replace("<", "&lt;")
    return _PAGE.format(path=quoted, style=_STYLE, script=_SCRIPT)


def page_headers() -> dict[str, str]:
    """Return the headers of the page: it runs its own script only, and connects to its own host only."""
    policy = (
        f"default-src 'none'; script-src '{_hash(_SCRIPT)}'; style-src '{_hash(_STYLE)}'; "
        "connect-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
    )
    return {
        "content-type": "text/html; charset=utf-8",
        "content-security-policy": policy,
        "referrer-policy": "no-referrer",
        "x-content-type-options": "nosniff",
        "cache-control": "no-store",
    }


def _hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
