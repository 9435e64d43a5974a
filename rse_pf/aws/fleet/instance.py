"""Query the metadata of this EC2 instance (IMDSv2) and the control port of its backend server.

Only link-local and loopback addresses are used, with a timeout of two seconds.
"""

from __future__ import annotations

import http.client
import json
import urllib.error
import urllib.request
from pathlib import Path

from rse_pf.auth.control_token import bearer, read_control_token
from rse_pf.aws.fleet.metrics import read_cpu_times
from rse_pf.config.resource_names import HEALTH_PATH, READY_PATH
from rse_pf.errors import Disconnected, UsageError

__all__ = ["INTERRUPTION", "IN_SERVICE", "TERMINATED", "WARMED", "Instance"]

# Target lifecycle state of an instance that is to serve robots.
IN_SERVICE = "InService"
# Target lifecycle state of an instance that is to be removed from the group.
TERMINATED = "Terminated"
# Prefix of the target lifecycle states of an instance that is to wait in the warm pool.
WARMED = "Warmed:"

INTERRUPTION = "interruption"
"""Result of `Instance.spot_notice` if AWS takes the Spot instance back within two minutes."""

_PROC_STAT = Path("/proc/stat")
_IMDS = "http://169.254.169.254/latest/"  # address of the instance metadata service
# Validity in seconds of a token for the instance metadata (an HTTP header); each token is used at once.
_TOKEN_TTL_S = "60"
# Time limit of a request to the metadata or to a server of this machine, in seconds.
_TIMEOUT_S = 2.0
_NOT_FOUND = 404


class Instance:
    """This EC2 instance: its metadata, its backend server's control port, and its data service."""

    def __init__(self, port: int, token_file: Path | None = None, data_port: int = 0) -> None:
        """Describe the ports of this instance; nothing is requested yet.

        Args:
            port: Control port of the backend server.
            token_file: File with the token of the control port; None if it needs none.
            data_port: Port of the data service; 0 if there is none.
        """
        self._base = f"http://127.0.0.1:{port}"
        self._token_file = token_file
        self._data_base = f"http://127.0.0.1:{data_port}/data" if data_port else ""

    def is_ready(self) -> bool:
        """Return whether the backend server takes robots and the data service, if there is one, answers.

        The store is not checked: all servers share it, and an instance that is never ready is terminated.
        """
        try:
            _ask(f"{self._base}{READY_PATH}", "GET", {})
            if self._data_base:
                _ask(f"{self._data_base}{HEALTH_PATH}", "GET", {})
        except (Disconnected, FileNotFoundError):
            return False
        return True

    def reaches_store(self) -> bool:
        """Return whether the store of the data service answers within two seconds.

        Raises:
            Disconnected: The data service itself does not answer, or this instance has none.
        """
        if not self._data_base:
            raise Disconnected("this instance has no data service")
        _ask(f"{self._data_base}{HEALTH_PATH}", "GET", {})
        try:
            _ask(f"{self._data_base}{READY_PATH}", "GET", {})
        except (Disconnected, FileNotFoundError):
            return False
        return True

    def page(self) -> str:
        """Return the text of the server's page /metrics; raises Disconnected if no server runs."""
        return self._ask("/metrics", "GET")

    def drain(self, wait_s: float) -> None:
        """Have the server drain after *wait_s* seconds; raises Disconnected if no server runs."""
        self._ask(f"/drain?wait={wait_s:g}", "POST")

    def move(self, robots: int, spread_s: float) -> int:
        """Have the server ask *robots* of its robots to move, spread over *spread_s* seconds.

        Return the number of robots that the server asks.

        Raises:
            Disconnected: No server runs, the server drains, or the answer cannot be read.
        """
        text = self._ask(f"/move?robots={robots}&spread_s={spread_s:g}", "POST")
        try:
            return int(json.loads(text)["robots"])
        except (ValueError, TypeError, KeyError) as error:
            raise Disconnected(f"the answer to /move is {text[:40]!r}") from error

    def reload_services(self) -> None:
        """Have the server load the published services; raises Disconnected if no server runs."""
        self._ask("/services", "POST")

    def cpu_times(self) -> tuple[float, float]:
        """Return the busy time and the total time of the machine's processors since its boot, in ticks."""
        return read_cpu_times(_PROC_STAT.read_text(encoding="ascii"))

    def spot_notice(self) -> str:
        """Return `INTERRUPTION` if AWS takes this instance back, ``rebalance`` if it may do so soon, else "".

        Raises:
            Disconnected: The instance has no metadata.
        """
        if self._metadata("spot/instance-action") is not None:
            return INTERRUPTION
        return "" if self._metadata("events/recommendations/rebalance") is None else "rebalance"

    def _ask(self, target: str, method: str) -> str:
        headers = {}
        if self._token_file is not None:
            try:
                headers["Authorization"] = bearer(read_control_token(self._token_file))
            except UsageError as error:  # no token file: it is made before the server starts, so none runs
                raise Disconnected(error.message) from error
        return _ask(f"{self._base}{target}", method, headers)

    def instance_id(self) -> str:
        """Return the id of this instance; raises Disconnected if the instance metadata do not answer."""
        return self._metadata("instance-id") or ""

    def target_state(self) -> str:
        """Return the lifecycle state that Auto Scaling wants the instance to have; raises Disconnected."""
        return self._metadata("autoscaling/target-lifecycle-state") or IN_SERVICE

    def _metadata(self, path: str) -> str | None:
        ttl = {"X-aws-ec2-metadata-token-ttl-seconds": _TOKEN_TTL_S}
        token = {"X-aws-ec2-metadata-token": _ask(f"{_IMDS}api/token", "PUT", ttl)}
        try:
            return _ask(f"{_IMDS}meta-data/{path}", "GET", token)
        except FileNotFoundError:
            return None


def _ask(url: str, method: str, headers: dict[str, str]) -> str:
    request = urllib.request.Request(url, method=method, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as answer:
            text: bytes = answer.read()
    except urllib.error.HTTPError as error:
        with error:
            if error.code == _NOT_FOUND:
                raise FileNotFoundError(url) from error
            raise Disconnected(f"{url} answers {error.code}") from error
    except (OSError, http.client.HTTPException) as error:
        raise Disconnected(f"{url} does not answer: {error}") from error
    return text.decode()
