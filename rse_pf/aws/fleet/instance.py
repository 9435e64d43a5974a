"""Ask the machine that this process runs on: its name and what its group wants of it (IMDSv2), its server.

Promises link-local and loopback addresses only, and short timeouts.
"""

from __future__ import annotations

import http.client
import urllib.error
import urllib.request
from pathlib import Path
from typing import Protocol

from rse_pf.auth.control_token import bearer, read_control_token
from rse_pf.errors import Disconnected, UsageError

__all__ = ["Instance", "Machine", "ServerControl"]

_IMDS = "http://169.254.169.254/latest/"
_TOKEN_S = "60"
_TIMEOUT_S = 2.0
_NOT_FOUND = 404


class Machine(Protocol):
    """What the agent needs of an instance and its server; tests play it."""

    def instance_id(self) -> str:
        """Return the instance's id."""

    def is_leaving(self) -> bool:
        """Whether the group has decided to end this instance."""

    def page(self) -> str:
        """Return the server's /metrics; raises Disconnected when no server runs."""

    def drain(self, wait_s: float) -> None:
        """Ask the server to leave; raises Disconnected when no server runs."""


class ServerControl:
    """The control port of the backend server on this machine; questions carry what is in *token_file*."""

    def __init__(self, port: int, token_file: Path | None = None) -> None:
        self._base = f"http://127.0.0.1:{port}"
        self._token_file = token_file

    def page(self) -> str:
        """Return /metrics; raises Disconnected."""
        return self._ask("/metrics", "GET")

    def drain(self, wait_s: float) -> None:
        """Order the drain; raises Disconnected."""
        self._ask(f"/drain?wait={wait_s:g}", "POST")

    def _ask(self, target: str, method: str) -> str:
        headers = {}
        if self._token_file is not None:
            try:
                headers["Authorization"] = bearer(read_control_token(self._token_file))
            except UsageError as error:  # it is made before the server starts: no server runs
                raise Disconnected(str(error)) from error
        return _asked(urllib.request.Request(f"{self._base}{target}", method=method, headers=headers))


class Instance(ServerControl):
    """This EC2 instance, with its server."""

    def instance_id(self) -> str:
        """Return the instance's id; raises Disconnected."""
        return self._metadata("instance-id") or ""

    def is_leaving(self) -> bool:
        """Whether the lifecycle state that the group aims at is the end; raises Disconnected."""
        return self._metadata("autoscaling/target-lifecycle-state") == "Terminated"

    def _metadata(self, path: str) -> str | None:
        life = {"X-aws-ec2-metadata-token-ttl-seconds": _TOKEN_S}
        token = _asked(urllib.request.Request(f"{_IMDS}api/token", method="PUT", headers=life))
        ask = urllib.request.Request(f"{_IMDS}meta-data/{path}", headers={"X-aws-ec2-metadata-token": token})
        try:
            return _asked(ask)
        except FileNotFoundError:
            return None


def _asked(request: urllib.request.Request) -> str:
    try:
        with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as answer:
            text: bytes = answer.read()
    except urllib.error.HTTPError as error:
        with error:
            if error.code == _NOT_FOUND:
                raise FileNotFoundError(request.full_url) from error
            raise Disconnected(f"{request.full_url} answers {error.code}") from error
    except (OSError, http.client.HTTPException) as error:
        raise Disconnected(f"{request.full_url} does not answer: {error}") from error
    return text.decode()
