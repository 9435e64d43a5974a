"""The instance metadata service as EC2 answers it, IMDSv2 only: run it where 169.254.169.254 is local.

python imds.py LIFECYCLE_FILE ROLE_FILE

Their texts are the target lifecycle state and the name of the instance's role; empty: none yet.
"""

from __future__ import annotations

import http.server
import json
import sys
from pathlib import Path

TOKEN = "a-session-token"
CREDENTIALS = {
    "AccessKeyId": "testing", "SecretAccessKey": "testing", "Token": "session", "Code": "Success",
    "Type": "AWS-HMAC", "LastUpdated": "2026-01-01T00:00:00Z", "Expiration": "2036-01-01T00:00:00Z",
}  # fmt: skip


class Metadata(http.server.BaseHTTPRequestHandler):
    """One request."""

    def do_PUT(self) -> None:
        named = self.headers.get("X-aws-ec2-metadata-token-ttl-seconds", "").isdigit()
        self._answer(200 if self.path == "/latest/api/token" and named else 400, TOKEN)

    def do_GET(self) -> None:
        base = "/latest/meta-data/"
        pages = {
            f"{base}instance-id": "i-0123456789abcdef0",
            f"{base}autoscaling/target-lifecycle-state": Path(sys.argv[1]).read_text(),
        }
        if role := Path(sys.argv[2]).read_text():
            pages[f"{base}iam/security-credentials/"] = role
            pages[f"{base}iam/security-credentials/{role}"] = json.dumps(CREDENTIALS)
        if self.headers.get("X-aws-ec2-metadata-token") != TOKEN:
            self._answer(401, "")
        else:
            self._answer(200 if self.path in pages else 404, pages.get(self.path, ""))

    def log_message(self, *arguments: object) -> None:
        """Stay silent."""

    def _answer(self, status: int, text: str) -> None:
        self.send_response(status)
        self.send_header("Content-Length", str(len(text)))
        self.end_headers()
        self.wfile.write(text.encode())


http.server.ThreadingHTTPServer(("169.254.169.254", 80), Metadata).serve_forever()
