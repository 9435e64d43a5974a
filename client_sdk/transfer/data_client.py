"""Store and fetch large data over HTTP: images, keyframes, point clouds, maps.

The data service is the HTTP interface of the platform's data servers, which keep the objects in a bucket (S3)
or on a disk.  `DataClient` blocks; an asyncio program runs it in a thread.  Objects are named by their
sha256, so a repeated or resumed transfer can neither store an object twice nor mix two versions.  An upload
returns when the data service has reported the object durable.  For a large object, the data service may offer
a presigned URL of its bucket, so that the bytes do not pass through a data server; if the transfer with that
URL fails, the bytes go through a data server.
"""

from __future__ import annotations

import functools
import hashlib
import http.client
import inspect
import io
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

from client_sdk.concurrency.user_callbacks import UserCallbacks
from client_sdk.enrolment import read_enrolment
from client_sdk.network.dial_errors import DialError
from client_sdk.transfer.data_connection import (
    MAX_SINGLE_PUT_BYTES,
    NO_UPSTREAM,
    DataConnection,
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
"""Called after each part with two numbers of bytes: those transferred so far, and all of the object."""

PIECE_BYTES = 1 << 20
"""Size of the ranges of a download, and of the pieces in which a file is read, in bytes."""
PRESIGNED_ATTEMPTS = 3
"""Failed requests with presigned URLs in one upload or download after which the rest of its bytes goes
through the data service: a bucket that the robot cannot reach must not stop the transfer."""
TEMPORARY_REDIRECT = 307
"""HTTP status by which the data service offers a presigned URL for a download."""
NO_SERVICE_TIMEOUT_S = 5.0
"""How long a request is repeated while the load balancer answers that the platform has no data server, in
seconds, if `DataOptions.deadline_s` is not shorter: a platform that starts needs seconds, and a platform
without a data service never gets one."""
RETRIED_STATUSES = {408, 429, 500, 502, 503, 504}
"""HTTP statuses after which a request is repeated, because the cause may pass; a refusal to store an object
(`StoreRefused`) is not repeated, whatever its status."""
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
    """Timeouts and repeats of a data client.

    Attributes:
        timeout_s: How long one attempt of a request may wait for the next bytes of its answer, in seconds.
        deadline_s: How long a failed request is repeated, in seconds; 5 s at most while the platform has no
            data server.  Each part of a transfer is a request of its own, so a large transfer may last
            longer, and fails after this time without progress.
        first_pause_s: Longest pause before the first repeat of a request, in seconds; it doubles with each
            repeat.  A pause is a random time from half of the longest pause to all of it.
        max_pause_s: The longest pause does not double beyond this, in seconds; a longer ``Retry-After`` of
            the data service is obeyed.
        part_bytes: Size of the parts of an upload, in bytes, unless the data service asks for smaller ones.
        clock: Monotonic seconds.
        sleep: Waits for a number of seconds.
        random: Source of the random pauses.
        ssl_context: TLS context for ``https:``, which holds the trusted certificate authorities; None trusts
            those of the machine.
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
    """Store and fetch objects and maps of one robot over one connection, which threads use in turn."""

    def __init__(self, url: str, token: str | Callable[[], str], options: DataOptions | None = None) -> None:
        """Store the arguments; nothing is sent yet.

        Args:
            url: Address of the data service, ``http://HOST:PORT`` or ``https://...``; or the ``ws:`` or
                ``wss:`` address of the backend servers, at whose host and port the data service is, too.
            token: The robot's token, or a callable that returns a valid one; it is called for each attempt of
                a request.
            options: Timeouts, repeats and part sizes; None means the defaults.

        Raises:
            UsageError: *url* has another scheme, or no usable host or port.
        """
        self.url = url
        self.token = token
        """The token of the next request, or the callable that returns it."""
        self._callbacks = UserCallbacks()
        self._options = options or DataOptions()
        self._connection = DataConnection(
            url, timeout_s=self._options.timeout_s, ssl_context=self._options.ssl_context
        )
        self._lock = threading.Lock()

    @classmethod
    def enrolled(cls, enrolment: str | Path) -> DataClient:
        """Return a client with the address, the key and the certificate authorities of an enrolment file.

        Args:
            enrolment: File of ``rse-pf robot enrol --out``.

        Raises:
            UsageError: The file cannot be read, or it holds no enrolment.
        """
        access = read_enrolment(enrolment)
        return cls(access.url, access.fresh_token, DataOptions(ssl_context=access.ssl_context))

    def close(self) -> None:
        """Close the connection; the next call opens another."""
        self._connection.close()

    def upload(self, source: bytes | Path, progress: OnBytes | None = None) -> str:
        """Store bytes or a file as an object, and return its sha256 once it is durable.

        If an earlier upload of the same bytes was interrupted, even in another process, it is resumed.
        *progress* is called after each part.

        Raises:
            ConnectError: There was no progress for ``deadline_s``, or no data service for 5 s.
            StoreFull, QuotaExceeded, LimitExceeded, Unauthorized, Forbidden: The server refuses the object.
            UsageError: The file cannot be read.
        """
        with self._lock, _open_source(source) as file:
            size, digest = file.seek(0, os.SEEK_END), _digest(file)
            if size <= MAX_SINGLE_PUT_BYTES:
                self._request(
                    "PUT", f"/data/v1/objects/{digest}", StoredReply, _read_at(file, 0, size), digest=digest
                )
                self._report(progress, size, size)
            else:
                self._upload_parts(file, size, digest, progress)
            return digest

    def download(self, digest: str, to: Path | None = None, progress: OnBytes | None = None) -> bytes:
        """Return the bytes of an object, or write them to the file *to* and return empty bytes.

        The bytes are verified by *digest*, the sha256 of the object.  The file *to* appears only when it is
        complete; until then the received bytes are in a hidden file in the same folder, from which the next
        call resumes an interrupted download.

        Raises:
            NotFound: This robot has no such object.
            StoreError: The received bytes do not match the digest; the hidden file is removed.
            ConnectError: There was no progress for ``deadline_s``, or no data service for 5 s.
        """
        with self._lock:
            return self._download(f"/data/v1/objects/{digest}", digest, to, progress)

    def delete(self, digest: str) -> None:
        """Remove the object with the sha256 *digest*; it is no error if there is none."""
        with self._lock:
            self._request("DELETE", f"/data/v1/objects/{digest}", bytes)

    def objects(self) -> Iterator[tuple[str, int]]:
        """Yield the sha256 and the size in bytes of each object of this robot, in the order of the sha256."""
        after = ""
        while True:
            with self._lock:
                page = self._reply("GET", f"/data/v1/objects?after={after}", _ObjectPage)
            yield from ((entry.digest, entry.size) for entry in page.objects)
            if page.next is None:
                return
            after = page.next

    def maps(self) -> dict[str, str]:
        """Return the names of all maps of this tenant, each with the id of its head, the newest version."""
        with self._lock:
            return {entry.name: entry.head for entry in self._reply("GET", "/data/v1/maps", _MapPage).maps}

    def map_version(self, name: str, version: str = "head") -> dict[str, Any]:
        """Return a version of the map *name* as a dict: its ``id`` and the ``record`` (`MapRecord`).

        *version* is the id of a version, or ``head`` for the newest one.

        Raises:
            NotFound: The tenant has no such map, or the map has no such version.
        """
        with self._lock:
            reply = self._reply("GET", f"{_versions_path(name)}/{version}", _MapVersion)
        description: dict[str, Any] = msgspec.to_builtins(reply)
        return description

    def download_map(self, name: str, version: str = "head", progress: OnBytes | None = None) -> bytes:
        """Return the encoded map of a version, for `rse_pf.maps.format.decode_map`.

        *name* and *version* are those of `map_version`, and so are the errors; *progress* is called after
        each part.
        """
        description = self.map_version(name, version)
        with self._lock:
            path = f"{_versions_path(name)}/{description['id']}/content"
            return self._download(path, description["record"]["digest"], None, progress)

    def commit_map(self, name: str, data: bytes, *, parent: str | None, note: str = "") -> str:
        """Upload an encoded map as the new head of the map *name*; return the id of this new version.

        Args:
            name: Name of the map.
            data: Encoded map.
            parent: Id of the present head, None if there is no such map yet.
            note: Text for people who read the history.

        Raises:
            Conflict: *parent* is not the head: another robot committed first, or this commit was stored, but
                its answer was lost, and the repeated request found it as the head.
        """
        body = {"digest": self.upload(data), "parent": parent, "note": note}
        with self._lock:
            return self._reply("POST", _versions_path(name), _MapVersion, json.dumps(body).encode()).id

    def update_map(self, name: str, data: bytes, *, note: str = "") -> str:
        """Upload an encoded map as the new head of the map *name*; return the id of this new version.

        The parent is the head at the time of the call, which is not merged with *data*: it stays in the
        history of the map.  If there is no such map yet, it is created.

        Raises:
            Conflict: As `commit_map`, if another robot commits during the call.
        """
        try:
            parent: str | None = self.map_version(name)["id"]
        except NotFound:
            parent = None
        return self.commit_map(name, data, parent=parent, note=note)

    def localise(self, name: str, photo: bytes, lens: PhotoLens) -> PhotoLocation:
        """Return the pose from which a photo was taken, in the head of the map *name*.

        A photo that shows no place of the map is no error: its ``verdict`` is ``lost``, without a pose.

        Args:
            name: Name of the map.
            photo: Bytes of a JPEG or PNG file.
            lens: Intrinsics of the camera that took it.

        Raises:
            NotFound: The tenant has no such map.
            BadRequest, LimitExceeded, InvalidCamera: The photo or its intrinsics cannot be used.
            Forbidden: The token lacks the scope ``maps:localise/MAP``.
        """
        query: dict[str, Any] = msgspec.to_builtins(lens)
        query |= {"distortion": ",".join(map(repr, lens.distortion))} if lens.distortion else {}
        with self._lock:
            path = f"{LOCALISE_PATH}{quote(name, safe='')}?{urlencode(query)}"
            return self._reply("POST", path, PhotoLocation, photo)

    def map_outline(self, name: str) -> MapOutline:
        """Return the head of the map *name* as seen from above: 2D positions of keyframes and points, metres.

        Raises:
            NotFound: The tenant has no such map.
            Forbidden: The token lacks the scope ``maps:localise/MAP``.
        """
        with self._lock:
            path = f"{LOCALISE_PATH}{quote(name, safe='')}"
            return self._reply("GET", path, MapOutline)

    def _upload_parts(self, file: BinaryIO, size: int, digest: str, progress: OnBytes | None) -> None:
        path = f"/data/v1/uploads/{digest}"
        request = json.dumps({"size": size}).encode()
        state = self._open_upload(path, request, file, size, digest, progress)
        part_bytes = min(state.part_bytes, self._options.part_bytes)
        offset = state.offset
        self._report(progress, offset, size)
        while offset < size:
            part = _read_at(file, offset, min(part_bytes, size - offset))
            try:
                state = self._reply(
                    "PATCH", path, _Upload, part, {"Upload-Offset": str(offset)}, digest=digest
                )
            except (Conflict, NotFound):
                # The answer to an earlier part was lost, or another process uploads the same object: ask how
                # many bytes the data service has.
                state = self._reply("PUT", path, _Upload, request, digest=digest)
            offset = state.offset
            self._report(progress, offset, size)

    def _open_upload(
        self, path: str, request: bytes, file: BinaryIO, size: int, digest: str, progress: OnBytes | None
    ) -> _Upload:
        """Open an upload, and send the object to a presigned URL if the data service offers one.

        The ``offset`` of the returned state is the number of bytes that the data service has: all of the
        object if it was sent to a presigned URL, else the part of it that an interrupted upload has stored.
        """
        attempts, pause_s = PRESIGNED_ATTEMPTS, self._options.first_pause_s
        while True:
            state = self._reply("PUT", path, _Upload, request, digest=digest)
            direct = state.direct
            if direct is None or not attempts or not self._may_use(direct.url):
                return state
            attempts -= 1
            body = _pieces(file, size, functools.partial(self._report, progress))
            if not _request_bucket("PUT", direct.url, direct.headers, body, self._options.timeout_s):
                self._options.sleep(pause_s)
                pause_s *= 2

    def _may_use(self, presigned_url: str) -> bool:
        return is_allowed(presigned_url, secure=self._connection.uses_tls)

    def _fetch_piece(self, path: str, headers: dict[str, str], route: _DownloadRoute) -> Response:
        """Fetch the range in *headers* from the presigned URL of *route*, else through the data service.

        If *route* has no URL, the data service is asked for one, and may answer with the bytes instead.  Each
        request that a presigned URL does not answer well costs *route* an attempt.
        """
        options = self._options
        while route.attempts_left:
            if not route.url:
                offer = {**headers, "X-Accept-Direct": "1"}
                expected = (TEMPORARY_REDIRECT, 416)
                status, answer, piece = self._request("GET", path, bytes, None, offer, expected=expected)
                if status != TEMPORARY_REDIRECT:
                    return status, answer, piece
                route.url = answer.get("Location", "")
            if self._may_use(route.url):
                response = _request_bucket("GET", route.url, headers, None, options.timeout_s)
                if response is not None:
                    return response
            # The presigned URL is not safe or has expired, or the bucket cannot be reached: ask for another
            # one.
            route.url, route.attempts_left = "", route.attempts_left - 1
            options.sleep(options.first_pause_s)
        return self._request("GET", path, bytes, None, headers, expected=(416,))

    def _download(self, path: str, digest: str, to: Path | None, progress: OnBytes | None) -> bytes:
        # 1. Begin with the bytes that an interrupted download has left in the hidden file.
        partial = None if to is None else to.with_name(f".{to.name}.{digest[:16]}.part")
        received = bytearray(partial.read_bytes() if partial is not None and partial.exists() else b"")
        # 2. Fetch one range after the other until nothing is missing.
        size, route = -1, _DownloadRoute()
        while size != len(received):
            end = len(received) + PIECE_BYTES - 1
            headers = {"Range": f"bytes={len(received)}-{end}"}
            status, answer, piece = self._fetch_piece(path, headers, route)
            content_range = answer.get("Content-Range", "")
            size = int(content_range.rpartition("/")[2]) if content_range else len(piece)
            if status == 200:
                received[:] = piece
            elif status == 206:
                received += piece
                _append(partial, piece)
            elif size != len(received):  # the hidden file is longer than the object: begin again
                received.clear()
                _remove(partial)
            self._report(progress, len(received), size)
        # 3. Verify the bytes, and rename the hidden file to *to*.
        if hashlib.sha256(received).hexdigest() != digest:
            _remove(partial)
            raise StoreError("the downloaded bytes do not match the digest", hint="download the object again")
        if to is None or partial is None:
            return bytes(received)
        partial.write_bytes(received)
        os.replace(partial, to)
        return b""

    def _read_token(self) -> object:
        if not callable(self.token):
            return self.token
        try:
            token: object = self.token()
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
        self,
        method: str,
        path: str,
        kind: type[T],
        body: bytes | None = None,
        headers: dict[str, str] | None = None,
        digest: str = "",
    ) -> T:
        return self._request(method, path, kind, body, headers, digest=digest)[2]

    def _request(
        self,
        method: str,
        path: str,
        kind: type[T],
        body: bytes | None = None,
        headers: dict[str, str] | None = None,
        *,
        expected: tuple[int, ...] = (),
        digest: str = "",
    ) -> tuple[int, http.client.HTTPMessage, T]:
        """Send a request, and repeat it while it fails in a way that may pass, for at most ``deadline_s``.

        No request of this class takes effect twice, so a repeat is safe when an answer was lost.  Only a
        commit is refused with `Conflict` when it is repeated after it took effect.

        Args:
            method: HTTP method.
            path: Path of the URL with the query.
            kind: Type of the reply; `bytes` returns the body as it is.
            body: Body of the request; None without one.
            headers: Further headers of the request.
            expected: HTTP statuses of 300 and above that are returned and not raised as errors.
            digest: The sha256 that a `StoredReply` must name; empty for any.

        Returns:
            HTTP status, headers and decoded reply.

        Raises:
            RsePfError: The error of the last attempt, or of the first one that a repeat cannot help.
        """
        options = self._options
        began_s, pause_s = options.clock(), options.first_pause_s
        until_s = began_s + options.deadline_s
        while True:
            error: RsePfError | None
            retry_after_s = 0.0
            try:
                token = self._read_token()
                response = self._connection.request(method, path, body, headers or {}, token)
                status, answer, content = response
                error = self._connection.failure(*response, expected)
                if error is None:
                    return status, answer, self._connection.decode(response, kind, digest)
            except ConnectError as connect_error:
                if self._connection.is_wrong_address:
                    raise
                error = connect_error
            else:
                if status not in RETRIED_STATUSES or isinstance(error, StoreRefused):
                    raise error
                if content == NO_UPSTREAM:
                    until_s = min(until_s, began_s + NO_SERVICE_TIMEOUT_S)
                retry_after = answer.get("Retry-After", "")
                retry_after_s = float(retry_after) if retry_after.isdecimal() else 0.0
            wait_s = max(retry_after_s, pause_s * options.random.uniform(0.5, 1.0))
            if options.clock() + wait_s > until_s:
                raise error
            options.sleep(wait_s)
            pause_s = min(2 * pause_s, options.max_pause_s)


@dataclass(slots=True)
class _DownloadRoute:
    """The presigned URL that a download uses, and how many requests with such URLs may still fail.

    An empty ``url`` means that the data service is asked for a new one; without ``attempts_left`` it is not
    asked again, and the bytes come through the data service.
    """

    url: str = ""
    attempts_left: int = PRESIGNED_ATTEMPTS


def _open_source(source: bytes | Path) -> BinaryIO:
    if isinstance(source, bytes):
        return io.BytesIO(source)
    try:
        return source.open("rb")
    except OSError as error:
        raise UsageError(
            f"cannot read {source}: {error.strerror}", hint="name a file that can be read"
        ) from error


def _read_at(file: BinaryIO, offset: int, length: int) -> bytes:
    file.seek(offset)
    return file.read(length)


def _pieces(file: BinaryIO, size: int, progress: Callable[[int, int], None]) -> Iterator[bytes]:
    """Yield the *size* bytes of *file* in pieces, and call *progress* after each piece."""
    for offset in range(0, size, PIECE_BYTES):
        yield _read_at(file, offset, PIECE_BYTES)
        progress(min(offset + PIECE_BYTES, size), size)


def _digest(file: BinaryIO) -> str:
    digest = hashlib.sha256()
    file.seek(0)
    while piece := file.read(PIECE_BYTES):
        digest.update(piece)
    return digest.hexdigest()


def is_allowed(url: str, *, secure: bool) -> bool:
    """Return whether a presigned *url* may carry data: ``https:``, and ``http:`` only if *secure* is False.

    *secure* says whether the robot reaches the data service itself by TLS.
    """
    parts = urlsplit(url)
    return bool(parts.hostname) and parts.scheme in (("https",) if secure else ("http", "https"))


def _request_bucket(
    method: str, url: str, headers: Mapping[str, str], body: Iterable[bytes] | None, timeout_s: float
) -> Response | None:
    """Send one request to a presigned *url*, without the robot's token; return None if it fails in any way.

    Status 416 counts as an answer to a GET: the range begins behind the end of the object.
    """
    parts = urlsplit(url)
    connection = None
    try:
        connection = open_connection(parts, timeout_s)
        connection.request(method, f"{parts.path}?{parts.query}", body, dict(headers))
        answer = connection.getresponse()
        response = answer.status, answer.headers, answer.read()
    except (OSError, ValueError, http.client.HTTPException, DialError, RsePfError):
        return None
    finally:
        if connection is not None:
            connection.close()
    return response if answer.status in ((200, 206, 416) if method == "GET" else (200, 201)) else None


def _versions_path(name: str) -> str:
    return f"/data/v1/maps/{quote(name, safe='')}/versions"


def _append(path: Path | None, piece: bytes) -> None:
    if path is not None:
        with path.open("ab") as file:
            file.write(piece)


def _remove(path: Path | None) -> None:
    if path is not None:
        path.unlink(missing_ok=True)
