"""Send and fetch large data by HTTP (paper, Sect. 5.2): images, keyframes, clouds, maps.

`DataClient` is blocking; run it in a thread.  Objects are named by their sha256, so a repeated or resumed
transfer can neither store an object twice nor mix two versions.  An upload returns when the data server has
reported the object durable.  Objects may take a presigned address of the service's bucket; when that fails,
the service carries the bytes itself.
"""

from __future__ import annotations

import functools
import hashlib
import http.client
import inspect
import json
import os
import random
import ssl
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, TypeVar
from urllib.parse import quote, urlencode, urlsplit

import msgspec

from client_sdk.concurrency.user_callbacks import Callbacks
from client_sdk.enrolment import read_enrolment
from client_sdk.network.http_proxy import TunnelRefused
from client_sdk.transfer.data_connection import (
    MAX_SINGLE_PUT_BYTES,
    NO_UPSTREAM,
    DataRequests,
    Response,
    StoredReply,
    open_connection,
)
from rse_pf.config.front_door import LOCALISE_PATH
from rse_pf.errors import (
    Conflict,
    ConnectError,
    NotFound,
    RsePfError,
    StoreError,
    StoreRefused,
    Unauthorized,
    UsageError,
)
from rse_pf.maps.photos import MapOutline, PhotoLens, PhotoLocation
from rse_pf.maps.record import MapRecord

__all__ = ["DataClient", "DataOptions", "OnBytes", "is_allowed"]

OnBytes = Callable[[int, int], None]
"""Called after each part with the bytes transferred and the bytes in total."""

_PIECE_BYTES = 1 << 20
_PRESIGNED_TRIES = 3
_REDIRECTED = 307
_NO_SERVICE_S = 5.0
_RETRIED = {408, 429, 500, 502, 503, 504}
T = TypeVar("T")


class _ObjectPage(msgspec.Struct, frozen=True, kw_only=True):
    objects: list[StoredReply]
    next: str | None = None


class _PresignedPut(msgspec.Struct, frozen=True, kw_only=True):
    url: str
    headers: dict[str, str]


class _Upload(StoredReply, frozen=True, kw_only=True):
    offset: int
    part_bytes: int
    direct: _PresignedPut | None = None


class _MapName(msgspec.Struct, frozen=True, kw_only=True):
    name: str
    head: str


class _MapPage(msgspec.Struct, frozen=True, kw_only=True):
    maps: list[_MapName]


class _MapVersion(msgspec.Struct, frozen=True, kw_only=True):
    id: str
    record: MapRecord


@dataclass(frozen=True, slots=True, kw_only=True)
class DataOptions:
    """Timeouts and retries of a client; ``deadline_s`` limits the time without any progress.

    ``ssl_context`` is for ``https:``; None trusts the authorities of the machine.
    """

    timeout_s: float = 10.0
    deadline_s: float = 60.0
    first_pause_s: float = 0.1
    max_pause_s: float = 5.0
    part_bytes: int = 1 << 20
    clock: Callable[[], float] = time.monotonic
    sleep: Callable[[float], None] = time.sleep
    random: random.Random = field(default_factory=random.Random)
    ssl_context: ssl.SSLContext | None = None


class DataClient:
    """A robot's client of the data service; one connection, used by one thread at a time."""

    def __init__(self, url: str, token: str | Callable[[], str], options: DataOptions | None = None) -> None:
        """Store the address; nothing is sent yet.

        Args:
            url: ``http://HOST:PORT`` or ``https://...``, or the ``ws:`` or ``wss:`` address of the servers.
            token: The robot's token, or a callable that returns a valid one.
            options: Timeouts, retries and part sizes.

        Raises:
            UsageError: *url* is not such an address.
        """
        self._token = token
        self._callbacks = Callbacks()
        self._options = options or DataOptions()
        self._requests = DataRequests(
            url, timeout_s=self._options.timeout_s, ssl_context=self._options.ssl_context
        )
        self._lock = threading.Lock()

    @classmethod
    def enrolled(cls, enrolment: str | Path) -> DataClient:
        """Return the client of a robot by its file of ``rse-pf robot enrol --out``.

        Raises:
            UsageError: The file cannot be used.
        """
        access = read_enrolment(enrolment)
        return cls(access.url, access.fresh_token, DataOptions(ssl_context=access.ssl_context))

    def close(self) -> None:
        """Close the connection; the next call opens another."""
        self._requests.close()

    def upload(self, source: bytes | Path, progress: OnBytes | None = None) -> str:
        """Store bytes or a file and return the digest, once the object is durable.

        An earlier upload of the same bytes is resumed, also one by another process.

        Raises:
            ConnectError: No progress for ``deadline_s``, or the platform has no data service for 5 s.
            StoreFull, QuotaExceeded, LimitExceeded, Unauthorized, Forbidden: The server refuses it.
            UsageError: The file cannot be read.
        """
        with self._lock, _Source(source) as opened:
            size, digest = opened.size, opened.digest()
            if size <= MAX_SINGLE_PUT_BYTES:
                self._request(
                    "PUT", f"/data/v1/objects/{digest}", StoredReply, opened.read(0, size), digest=digest
                )
                self._report(progress, size, size)
            else:
                self._upload_parts(opened, digest, progress)
            return digest

    def download(self, digest: str, to: Path | None = None, progress: OnBytes | None = None) -> bytes:
        """Return an object, or write it to file *to* (and return no bytes), verified by its digest.

        The file appears only when it is complete; an interrupted download is kept beside it and resumed.

        Raises:
            NotFound: There is no such object of this robot.
            StoreError: The bytes do not match the digest.
        """
        with self._lock:
            return self._download(f"/data/v1/objects/{digest}", digest, to, progress)

    def delete(self, digest: str) -> None:
        """Remove an object; a missing one is no error."""
        with self._lock:
            self._request("DELETE", f"/data/v1/objects/{digest}", bytes)

    def objects(self) -> Iterator[tuple[str, int]]:
        """Yield digest and size of each of this robot's objects."""
        after = ""
        while True:
            with self._lock:
                page = self._reply("GET", f"/data/v1/objects?after={after}", _ObjectPage)
            yield from ((entry.digest, entry.size) for entry in page.objects)
            if page.next is None:
                return
            after = page.next

    def maps(self) -> dict[str, str]:
        """Return the maps of this tenant: name to id of the head."""
        with self._lock:
            return {entry.name: entry.head for entry in self._reply("GET", "/data/v1/maps", _MapPage).maps}

    def map_version(self, name: str, version: str = "head") -> dict[str, Any]:
        """Return ``id`` and ``record`` of a version of a map."""
        with self._lock:
            reply = self._reply("GET", f"{_versions(name)}/{version}", _MapVersion)
        description: dict[str, Any] = msgspec.to_builtins(reply)
        return description

    def download_map(self, name: str, version: str = "head", progress: OnBytes | None = None) -> bytes:
        """Return a version's bytes, for `rse_pf.maps.format.decode_map`."""
        description = self.map_version(name, version)
        with self._lock:
            path = f"{_versions(name)}/{description['id']}/content"
            return self._download(path, description["record"]["digest"], None, progress)

    def commit_map(self, name: str, data: bytes, *, parent: str | None, note: str = "") -> str:
        """Upload the bytes of a map and make them the head; return the version's id.

        Raises:
            Conflict: Another robot committed first: *parent* is no longer the head.
        """
        body = {"digest": self.upload(data), "parent": parent, "note": note}
        with self._lock:
            return self._reply("POST", _versions(name), _MapVersion, json.dumps(body).encode()).id

    def update_map(self, name: str, data: bytes, *, note: str = "") -> str:
        """Upload the bytes of a map and make them the head, whatever it was; return the version's id.

        Raises:
            Conflict: Another robot committed at the same moment.
        """
        try:
            parent: str | None = self.map_version(name)["id"]
        except NotFound:
            parent = None
        return self.commit_map(name, data, parent=parent, note=note)

    def localise(self, name: str, photo: bytes, lens: PhotoLens) -> PhotoLocation:
        """Return where a photo was taken in the head of a map.

        Args:
            name: Of the map.
            photo: A JPEG or PNG, as its file has it.
            lens: Intrinsics of the camera that took it.

        Raises:
            NotFound: There is no such map of this tenant.
            BadRequest, LimitExceeded, InvalidCamera: The photo or its intrinsics cannot be used.
            Forbidden: The token has not the scope ``maps:localise/MAP``.
        """
        query: dict[str, Any] = msgspec.to_builtins(lens)
        query |= {"distortion": ",".join(map(repr, lens.distortion))} if lens.distortion else {}
        with self._lock:
            path = f"{LOCALISE_PATH}{quote(name, safe='')}?{urlencode(query)}"
            return self._reply("POST", path, PhotoLocation, photo)

    def map_outline(self, name: str) -> MapOutline:
        """Return the head of a map as it is seen from above; raises as `localise`."""
        with self._lock:
            path = f"{LOCALISE_PATH}{quote(name, safe='')}"
            return self._reply("GET", path, MapOutline)

    def _upload_parts(self, opened: _Source, digest: str, progress: OnBytes | None) -> None:
        path, size = f"/data/v1/uploads/{digest}", opened.size
        begin = json.dumps({"size": size}).encode()
        state = self._begin(path, begin, opened, digest, progress)
        part_bytes = min(state.part_bytes, self._options.part_bytes)
        offset = state.offset
        self._report(progress, offset, size)
        while offset < size:
            part = opened.read(offset, min(part_bytes, size - offset))
            try:
                state = self._reply(
                    "PATCH", path, _Upload, part, {"Upload-Offset": str(offset)}, digest=digest
                )
            except (
                Conflict,
                NotFound,
            ):  # the answer to this part was lost, or another process uploads the same object
                state = self._reply("PUT", path, _Upload, begin, digest=digest)
            offset = state.offset
            self._report(progress, offset, size)

    def _begin(
        self, path: str, begin: bytes, opened: _Source, digest: str, progress: OnBytes | None
    ) -> _Upload:
        """Open an upload, and send the object to a presigned address if the service offers one."""
        tries, pause = _PRESIGNED_TRIES, self._options.first_pause_s
        while True:
            state = self._reply("PUT", path, _Upload, begin, digest=digest)
            direct = state.direct
            if direct is None or not tries or not is_allowed(direct.url, secure=self._requests.secure):
                return state
            tries -= 1
            body = opened.pieces(functools.partial(self._report, progress))
            if not _ask_bucket("PUT", direct.url, direct.headers, body, self._options.timeout_s):
                self._options.sleep(pause)
                pause *= 2

    def _piece(self, path: str, headers: dict[str, str], route: _Route) -> Response:
        """Fetch a range from a presigned address if the service offers one, else from the service."""
        options = self._options
        while route.tries:
            if not route.url:
                offer = {**headers, "X-Accept-Direct": "1"}
                status, answer, piece = self._request(
                    "GET", path, bytes, None, offer, also=(_REDIRECTED, 416)
                )
                route.url = answer.get("Location", "") if status == _REDIRECTED else ""
                if status != _REDIRECTED:
                    return status, answer, piece
            if is_allowed(route.url, secure=self._requests.secure):
                response = _ask_bucket("GET", route.url, headers, None, options.timeout_s)
                if response is not None:
                    return response
            route.url, route.tries = "", route.tries - 1  # expired, or the bucket cannot be reached
            options.sleep(options.first_pause_s)
        return self._request("GET", path, bytes, None, headers, also=(416,))

    def _download(self, path: str, digest: str, to: Path | None, progress: OnBytes | None) -> bytes:
        partial = None if to is None else to.with_name(f".{to.name}.{digest[:16]}.part")
        held = bytearray(partial.read_bytes() if partial is not None and partial.exists() else b"")
        size, route = -1, _Route()
        while size != len(held):
            end = len(held) + _PIECE_BYTES - 1
            headers = {"Range": f"bytes={len(held)}-{end}"}
            status, answer, piece = self._piece(path, headers, route)
            content_range = answer.get("Content-Range", "")
            size = int(content_range.rpartition("/")[2]) if content_range else len(piece)
            if status == 200:
                held[:] = piece
            elif status == 206:
                held += piece
                _append(partial, piece)
            elif size != len(held):  # the partial file is longer than the object
                held.clear()
                _remove(partial)
            self._report(progress, len(held), size)
        if hashlib.sha256(held).hexdigest() != digest:
            _remove(partial)
            raise StoreError("the bytes do not match the digest", hint="fetch it again")
        if to is None or partial is None:
            return bytes(held)
        partial.write_bytes(held)
        os.replace(partial, to)
        return b""

    def _read_token(self) -> object:
        if not callable(self._token):
            return self._token
        try:
            token: object = self._token()
        except Exception as error:
            raise self._callbacks.token_error(error) from error
        if inspect.iscoroutine(token):
            token.close()
            raise Unauthorized(
                "the token callable of DataClient is an async function",
                hint="pass read_enrolment(FILE).fresh_token, or use DataClient.enrolled(FILE)",
            )
        return token

    def _report(self, progress: OnBytes | None, done: int, size: int) -> None:
        if progress is not None:
            self._callbacks.call("progress", progress, done, size)

    def _reply(
        self, method: str, path: str, kind: type[T], body: bytes | None = None,
        headers: dict[str, str] | None = None, digest: str = "",
    ) -> T:  # fmt: skip
        return self._request(method, path, kind, body, headers, digest=digest)[2]

    def _request(
        self, method: str, path: str, kind: type[T], body: bytes | None = None,
        headers: dict[str, str] | None = None, *, also: tuple[int, ...] = (), digest: str = "",
    ) -> tuple[int, http.client.HTTPMessage, T]:  # fmt: skip
        """Repeat a request until it succeeds or is refused; all requests of this class are idempotent."""
        options = self._options
        begin, pause = options.clock(), options.first_pause_s
        end = begin + options.deadline_s
        while True:
            error: RsePfError | None
            after_s = 0.0
            try:
                token = self._read_token()
                response = self._requests.request(method, path, body, headers or {}, token)
                status, answer, content = response
                error = self._requests.failure(*response, also)
                if error is None:
                    return status, answer, self._requests.decode(response, kind, digest)
            except ConnectError as broken:
                if self._requests.is_wrong_address:
                    raise
                error = broken
            else:
                if status not in _RETRIED or isinstance(error, StoreRefused):
                    raise error
                if content == NO_UPSTREAM:
                    end = min(end, begin + _NO_SERVICE_S)
                retry_after = answer.get("Retry-After", "")
                after_s = float(retry_after) if retry_after.isdecimal() else 0.0
            wait_s = max(after_s, pause * options.random.uniform(0.5, 1.0))
            if options.clock() + wait_s > end:
                raise error
            options.sleep(wait_s)
            pause = min(2 * pause, options.max_pause_s)


@dataclass(slots=True)
class _Route:
    """How a download is fetched: from the presigned *url*, or from the service when no tries are left."""

    url: str = ""
    tries: int = _PRESIGNED_TRIES


class _Source:
    """Bytes or a file, read at any offset."""

    def __init__(self, source: bytes | Path) -> None:
        self._data = source if isinstance(source, bytes) else b""
        self._file: BinaryIO | None = None
        if isinstance(source, Path):
            try:
                self._file = source.open("rb")
            except OSError as error:
                raise UsageError(f"cannot read {source}: {error.strerror}", hint="name a file") from error
        self.size = os.fstat(self._file.fileno()).st_size if self._file else len(self._data)

    def digest(self) -> str:
        digest = hashlib.sha256()
        for piece in self.pieces(None):
            digest.update(piece)
        return digest.hexdigest()

    def pieces(self, progress: OnBytes | None) -> Iterator[bytes]:
        for offset in range(0, self.size, _PIECE_BYTES):
            yield self.read(offset, _PIECE_BYTES)
            if progress is not None:
                progress(min(offset + _PIECE_BYTES, self.size), self.size)

    def read(self, offset: int, length: int) -> bytes:
        if self._file is None:
            return self._data[offset : offset + length]
        self._file.seek(offset)
        return self._file.read(length)

    def __enter__(self) -> _Source:
        return self

    def __exit__(self, *_: object) -> None:
        if self._file is not None:
            self._file.close()


def is_allowed(url: str, *, secure: bool) -> bool:
    """Return whether a presigned *url* may be used with a data service that is reached by TLS or without."""
    parts = urlsplit(url)
    return bool(parts.hostname) and parts.scheme in (("https",) if secure else ("http", "https"))


def _ask_bucket(
    method: str, url: str, headers: Mapping[str, str], body: Iterable[bytes] | None, timeout_s: float
) -> Response | None:
    """Send exactly *headers*, never the token, to a presigned address; None unless the request succeeded."""
    parts = urlsplit(url)
    connection = None
    try:
        connection = open_connection(parts, timeout_s)
        connection.request(method, f"{parts.path}?{parts.query}", body, dict(headers))
        answer = connection.getresponse()
        response = answer.status, answer.headers, answer.read()
    except (OSError, ValueError, http.client.HTTPException, TunnelRefused, RsePfError):
        return None
    finally:
        if connection is not None:
            connection.close()
    return response if answer.status in ((200, 206, 416) if method == "GET" else (200, 201)) else None


def _versions(name: str) -> str:
    return f"/data/v1/maps/{quote(name, safe='')}/versions"


def _append(path: Path | None, piece: bytes) -> None:
    if path is not None:
        with path.open("ab") as file:
            file.write(piece)


def _remove(path: Path | None) -> None:
    if path is not None:
        path.unlink(missing_ok=True)
