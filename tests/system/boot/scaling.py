"""Auto Scaling as far as a new machine calls it: CompleteLifecycleAction, over HTTPS, written to a file.

python scaling.py HOST CERTIFICATE KEY FILE

Each hook waits once; a second completion is refused, as AWS does.
"""

from __future__ import annotations

import http.server
import ssl
import sys
import urllib.parse
from pathlib import Path

HOST, CERTIFICATE, KEY, FILE = sys.argv[1], sys.argv[2], sys.argv[3], Path(sys.argv[4])
DONE = "<CompleteLifecycleActionResponse><CompleteLifecycleActionResult/></CompleteLifecycleActionResponse>"
REFUSED = (
    "<ErrorResponse><Error><Type>Sender</Type><Code>ValidationError</Code>"
    "<Message>No active Lifecycle Action found</Message></Error></ErrorResponse>"
)


class Scaling(http.server.BaseHTTPRequestHandler):
    """One call, by GET or by POST."""

    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        self._answer(urllib.parse.urlsplit(self.path).query)

    def do_POST(self) -> None:
        self._answer(self.rfile.read(int(self.headers["Content-Length"])).decode())

    def log_message(self, *arguments: object) -> None:
        """Stay silent."""

    def _answer(self, query: str) -> None:
        call = dict(urllib.parse.parse_qsl(query))
        done = FILE.read_text()
        is_known = call.get("Action") == "CompleteLifecycleAction" and "AWS4-HMAC" in str(
            self.headers["Authorization"]
        )
        fresh = is_known and f"{call['LifecycleHookName']} " not in done
        if fresh:
            FILE.write_text(f"{done}{call['LifecycleHookName']} {call['LifecycleActionResult']}\n")
        text = (DONE if fresh else REFUSED).encode()
        self.send_response(200 if fresh else 400)
        self.send_header("Content-Length", str(len(text)))
        self.end_headers()
        self.wfile.write(text)


server = http.server.ThreadingHTTPServer((HOST, 443), Scaling)
context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
context.load_cert_chain(CERTIFICATE, KEY)
server.socket = context.wrap_socket(server.socket, server_side=True)
server.serve_forever()
