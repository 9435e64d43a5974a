"""Read the public keys, the roster and the deny list from the artifact bucket, without an AWS SDK.

Without an SDK the package stays small and its import fast.  An execution environment may live for hours, so
all three are fetched again once in a period, each by one signed GET without retries.  While a fetch fails,
the previous values are kept without a limit in time, as servers do: see docs/decisions/identity.md.
"""

from __future__ import annotations

import hashlib
import hmac
import sys
import urllib.error
import urllib.request
from collections.abc import Callable, Mapping
from datetime import datetime
from typing import TypeVar

from rse_pf.auth.roster import DenyList, Roster, from_json
from rse_pf.auth.tokens import KeySet
from rse_pf.errors import NotFound, RsePfError, message_of

__all__ = ["KeyCache", "read_object", "signed_request"]

# Time limit of one GET, in seconds: three of them fit into the function's time limit of 10 s.
_FETCH_TIMEOUT_S = 3.0
# Pause after a failed fetch, in seconds, so that not every request waits for a bucket that does not answer.
_RETRY_PAUSE_S = 5.0
_NOT_FOUND = 404
_T = TypeVar("_T", Roster, DenyList)


class KeyCache:
    """The public keys with roster and deny list, fetched again once in a period."""

    def __init__(
        self, read: Callable[[], str], period_s: float, *, read_control: Callable[[str], str] | None = None
    ) -> None:
        """Describe the cache; nothing is fetched yet.

        Args:
            read: Returns the public keys as a JWKS (JSON).
            period_s: Seconds between two fetches.
            read_control: Returns the object ``robots.json`` or ``deny.json``, or raises NotFound; None means
                that there is neither roster nor deny list.
        """
        self._read = read
        self._read_control = read_control
        self._period_s = period_s
        self._keys = KeySet({})
        self._found: set[str] = set()
        self._due_s: float | None = None

    def at(self, clock_s: float) -> KeySet:
        """Return the keys, fetched again if a period has passed by *clock_s* (monotonic seconds).

        If the fetch fails, write a line to stderr and return the previous keys; none if there are none yet.
        """
        if self._due_s is None or clock_s >= self._due_s:
            try:
                self._keys = KeySet.from_json(self._read()).with_access_control(
                    self._access_control("robots.json", Roster), self._access_control("deny.json", DenyList)
                )
                self._due_s = clock_s + self._period_s
            except (OSError, RsePfError) as error:
                self._due_s = clock_s + min(_RETRY_PAUSE_S, self._period_s)
                sys.stderr.write(
                    f"cannot fetch the keys: {message_of(error)}; "
                    "create them with rse-pf token init --cloud\n"
                )
        return self._keys

    def _access_control(self, name: str, kind: type[_T]) -> _T:
        """Return the roster or the deny list in the object *name*; an empty one if it was never written.

        Raises:
            NotFound: The object was there at an earlier fetch, so it must not count as empty.
        """
        if self._read_control is None:
            return kind()
        try:
            control_list = from_json(self._read_control(name), kind)
        except NotFound:
            if name in self._found:
                raise
            return kind()
        self._found.add(name)
        return control_list


def read_object(environment: Mapping[str, str], now: datetime, control: str = "") -> str:
    """Return the text of an object in the artifact bucket; arguments as for `signed_request`.

    Raises:
        NotFound: There is no such object.
        OSError: S3 does not answer, or refuses.
    """
    try:
        with urllib.request.urlopen(
            signed_request(environment, now, control), timeout=_FETCH_TIMEOUT_S
        ) as answer:
            text: bytes = answer.read()
    except urllib.error.HTTPError as error:
        with error:
            if error.code == _NOT_FOUND:
                raise NotFound(f"there is no {control or 'key set'} in the bucket") from error
            raise
    return text.decode()


def signed_request(
    environment: Mapping[str, str], now: datetime, control: str = ""
) -> urllib.request.Request:
    """Return a GET request of an object in S3, signed with AWS Signature Version 4.

    Args:
        environment: Environment variables of the function: ``RSE_PF_KEYS`` is BUCKET/NAME of the public keys;
            Lambda sets the region and the credentials.
        now: The time in UTC.
        control: Name of an object in the folder ``control`` next to the keys; empty means the keys.
    """
    bucket, _, keys = environment["RSE_PF_KEYS"].partition("/")
    name = f"{keys.rpartition('/')[0]}/control/{control}".lstrip("/") if control else keys
    region = environment["AWS_REGION"]
    domain = environment.get("RSE_PF_AWS_DOMAIN", "amazonaws.com")
    host, stamp = f"{bucket}.s3.{region}.{domain}", now.strftime("%Y%m%dT%H%M%SZ")
    digest = hashlib.sha256(b"").hexdigest()
    headers = {"host": host, "x-amz-content-sha256": digest, "x-amz-date": stamp}
    if environment.get("AWS_SESSION_TOKEN"):
        headers["x-amz-security-token"] = environment["AWS_SESSION_TOKEN"]
    names = ";".join(sorted(headers))
    lines = "".join(f"{name}:{headers[name]}\n" for name in sorted(headers))
    request = "\n".join(["GET", f"/{name}", "", lines, names, digest])
    scope = f"{stamp[:8]}/{region}/s3/aws4_request"
    text = "\n".join(["AWS4-HMAC-SHA256", stamp, scope, hashlib.sha256(request.encode()).hexdigest()])
    key = f"AWS4{environment['AWS_SECRET_ACCESS_KEY']}".encode()
    for part in scope.split("/"):
        key = hmac.new(key, part.encode(), hashlib.sha256).digest()
    headers["authorization"] = (
        f"AWS4-HMAC-SHA256 Credential={environment['AWS_ACCESS_KEY_ID']}/{scope}, SignedHeaders={names}, "
        f"Signature={hmac.new(key, text.encode(), hashlib.sha256).hexdigest()}"
    )
    return urllib.request.Request(f"https://{host}/{name}", headers=headers)
