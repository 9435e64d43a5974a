"""The handlers of the data service, one for each route; calls of the store run in threads.

Tenant and robot are taken only from the token.  A request for another robot's object gets 404.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import re
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import msgspec

from rse_pf.audit.entry import Entry
from rse_pf.audit.log import AuditLog
from rse_pf.auth.tokens import Claims
from rse_pf.config import DataSettings
from rse_pf.data_server.fair_threads import FairThreads, check_wanted
from rse_pf.data_server.http import (
    HttpReply,
    HttpRequest,
    check_preconditions,
    failure_reply,
    has_conditions,
    json_reply,
    requested_range,
    wants_range,
)
from rse_pf.data_server.photo_localiser import PhotoLocaliser
from rse_pf.data_server.routes import (
    BYTES,
    Commit,
    MapName,
    MapPage,
    MapVersionInfo,
    MoveHead,
    ObjectPage,
    PresignedPut,
    Pruned,
    ServiceHealth,
    StoredObject,
    Upload,
    UploadBegin,
    openapi_page,
)
from rse_pf.data_server.uploads import Objects
from rse_pf.errors import BadRequest, Conflict, NotFound
from rse_pf.identity import RobotId
from rse_pf.maps.describe import MapSummary
from rse_pf.maps.photos import PhotoLens
from rse_pf.maps.registry import MapContent, MapOrigin, MapRecord, MapRegistry
from rse_pf.maps.removal import choose_superseded, count_freed_bytes
from rse_pf.storage.object_store import DirectoryStore, ObjectStore, PresigningStore
from rse_pf.storage.quotas import charge_name

__all__ = ["Handler", "Handlers", "MapWork"]

_T = TypeVar("_T")
# A function that replies to a request, given the claims of its token and the parameters of its path.
Handler = Callable[[HttpRequest, Claims, dict[str, str]], Awaitable[HttpReply]]

_PIECE_BYTES = 1 << 20  # a thread reads an object in pieces of this size, so that memory stays bounded
_CACHED_PIECE_BYTES = 1 << 19  # most bytes that the event loop itself copies at once from the file cache
_MAX_JSON_BYTES = 16384  # longest JSON body of a request; a commit with a note of 500 letters is the longest
_MAX_NOTE_LETTERS = 500  # length of the note that a robot gives to a version of a map
_MAX_PAGE_OBJECTS = 1000  # objects in one page of a list, as many as S3 lists at once
PRESIGNED_URL_TTL_S = 300  # validity of a presigned URL, s: long enough to begin one transfer
_DIGEST_PREFIX = re.compile(r"[0-9a-f]{0,64}")  # a sha256 in hexadecimal, or its beginning
_MAP_THREADS = 1  # threads that wait for the one process that reads committed maps; others serve objects
_MISSING_OBJECT = "ready/probe"  # name that is never stored: a store that answers reports it as missing
_LENS_PARAMETERS = frozenset(PhotoLens.__struct_fields__)  # query parameters that describe a lens
_VERSION_COUNT = re.compile(r"[0-9]{1,6}")  # value of the query parameter ``keep``


@dataclass(frozen=True, slots=True)
class MapWork:
    """The functions that read maps in other processes.

    Attributes:
        describe: Returns the summary of the map in an object, given the robot and the object's name.
        localiser: Localises photos in maps.
        charge: Counts the CPU seconds of a robot's photo against its rate limit.
    """

    describe: Callable[[RobotId, str], MapSummary]
    localiser: PhotoLocaliser
    charge: Callable[[RobotId, float], None]


class Handlers:
    """The handlers of all routes: the method for a route has the name of the route's *operation*."""

    def __init__(
        self,
        store: ObjectStore,
        settings: DataSettings,
        map_work: MapWork,
        *,
        clock: Callable[[], float] = time.monotonic,
        wall_clock: Callable[[], float] = time.time,
        audit: AuditLog | None = None,
    ) -> None:
        """Make the handlers, whose threads start with the first request; the caller closes *map_work*."""
        self._store = store
        self._cached = store if isinstance(store, DirectoryStore) else None
        self._audit = audit
        self._settings = settings
        self._wall_clock = wall_clock
        self._describe = map_work.describe
        self.threads = FairThreads()
        self._localiser = map_work.localiser
        self._charge_cpu = map_work.charge
        self._map_threads = FairThreads(_MAP_THREADS)
        self._photo_threads = FairThreads(map_work.localiser.count)
        self.objects = Objects(store, settings, clock, wall_clock)
        self._document = openapi_page().encode()

    def close(self) -> None:
        """Drop waiting work, and wait until all threads have finished their running work."""
        self.threads.close()
        self._map_threads.close()
        self._photo_threads.close()

    async def healthz(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Reply 200, without using the store."""
        return json_reply(200, ServiceHealth(status="ok"))

    async def readyz(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Reply 200 if the store answers that a missing object does not exist; raise its other errors."""
        with contextlib.suppress(NotFound):
            await asyncio.to_thread(self._store.head, _MISSING_OBJECT)
        return json_reply(200, ServiceHealth(status="ready"))

    async def document(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Reply with the OpenAPI document of this service, as JSON."""
        return HttpReply(status=200, body=self._document)

    async def list_objects(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Reply with the robot's objects above the digest ``after``, at most ``limit``, sorted by digest."""
        text = request.query.get("limit", str(_MAX_PAGE_OBJECTS))
        limit = int(text) if text.isdecimal() and text.isascii() and len(text) < 6 else 0
        if not 1 <= limit <= _MAX_PAGE_OBJECTS:
            raise BadRequest(f"limit {text[:40]!r} is not in 1 to {_MAX_PAGE_OBJECTS}", hint="leave it out")
        after = request.query.get("after", "")
        if not _DIGEST_PREFIX.fullmatch(after):
            raise BadRequest(f"after={after[:80]!r} begins no digest", hint="use next of the page before")
        listed, more = await self.threads.run(claims.robot, self.objects.list, claims, after, limit)
        page = [StoredObject(digest=info.name.rpartition("/")[2], size=info.size) for info in listed]
        return json_reply(200, ObjectPage(objects=page, next=page[-1].digest if more else None))

    async def get_object(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Reply with an object of the robot, or with the range of it that the request names."""
        digest = path["digest"]
        name = self.objects.name(claims, digest)
        if self._cached is not None and "range" not in request.headers:
            cached = self._cached.get_cached(name, 0, _CACHED_PIECE_BYTES)
            if cached is not None:  # faster than to hand the request to a thread
                return await self._content(request, claims.robot, name, cached[0], digest, cached[1])
        return await self._content(request, claims.robot, *await self._head(claims, digest), digest)

    async def head_object(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Reply with the size of an object in Content-Length and its digest as ETag; 304 if a tag matches."""
        _, size = await self._head(claims, path["digest"])
        headers = _content_headers(path["digest"])
        if not check_preconditions(request, path["digest"]):
            return HttpReply(status=304, headers=headers, media_type=BYTES)
        return HttpReply(status=200, headers={**headers, "Content-Length": str(size)}, media_type=BYTES)

    async def _check_change(self, request: HttpRequest, claims: Claims, digest: str) -> None:
        """Check that *digest* is a sha256 and that ``If-Match`` and ``If-None-Match`` of *request* hold.

        Raises:
            NotFound: *digest* is no sha256.
            PreconditionFailed: A condition does not hold, so the object must not be changed.
        """
        self.objects.name(claims, digest)
        if has_conditions(request):
            tag: str | None = digest
            try:
                await self._head(claims, digest)
            except NotFound:
                tag = None
            check_preconditions(request, tag)

    async def _head(self, claims: Claims, digest: str) -> tuple[str, int]:
        """Return the name of an object in the store and its size in bytes; raises NotFound."""
        name = self.objects.name(claims, digest)
        cached = None if self._cached is None else self._cached.get_cached(name, 0, 0)
        if cached is not None:
            return name, cached[0]
        info = await self.threads.run(claims.robot, self.objects.head, claims, digest)
        return info.name, info.size

    async def put_object(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Store an object of at most ``data.part_bytes``: 201 if it is new, 200 if it existed."""
        await self._check_change(request, claims, path["digest"])
        data = await request.body(self._settings.part_bytes)
        new = await self.threads.run(claims.robot, self.objects.put, claims, path["digest"], data)
        return json_reply(201 if new else 200, StoredObject(digest=path["digest"], size=len(data)))

    async def delete_object(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Remove an object of the robot; a missing one is no error."""
        await self._check_change(request, claims, path["digest"])
        await self.threads.run(claims.robot, self.objects.delete, claims, path["digest"])
        return HttpReply(status=204)

    async def begin_upload(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Open an upload in parts, or find the open one; reply with its state.

        The reply also has a presigned URL if the store makes them and no part is stored yet.
        """
        begin = await _json_body(request, UploadBegin)
        if begin.size < 1:
            raise BadRequest(f"a size of {begin.size} bytes needs no upload", hint="PUT the object")
        state = await self.threads.run(claims.robot, self.objects.begin, claims, path["digest"], begin.size)
        direct = await self.threads.run(claims.robot, self._presigned_put, claims, state)
        return _upload(200, msgspec.structs.replace(state, direct=direct))

    def _presigned_put(self, claims: Claims, state: Upload) -> PresignedPut | None:
        """Return a URL for one PUT of the whole object directly to the bucket.

        None if a part of the upload is stored already, or if the store makes no presigned URLs.
        """
        store, ttl_s = self._store, PRESIGNED_URL_TTL_S
        if state.offset or not isinstance(store, PresigningStore):
            return None
        name = self.objects.name(claims, state.digest)
        url, headers = store.presigned_put(name, size=state.size, sha256=state.digest, ttl_s=ttl_s)
        return PresignedPut(url=url, headers=headers, life_s=ttl_s)

    async def get_upload(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Reply with the state of an upload: its size and the offset at which the next part begins."""
        return _upload(
            200, await self.threads.run(claims.robot, self.objects.progress, claims, path["digest"])
        )

    head_upload = get_upload

    async def append_part(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Store the part at ``Upload-Offset``: 201 if the object is complete with it, else 200."""
        offset = request.header_number("Upload-Offset")
        if offset is None:
            raise BadRequest("the header Upload-Offset is missing", hint="send the offset of this part")
        self.objects.name(claims, path["digest"])
        data = await request.body(self._settings.part_bytes)
        state = await self.threads.run(
            claims.robot, self.objects.append, claims, path["digest"], offset, data
        )
        return _upload(201 if state.offset == state.size else 200, state)

    async def abandon_upload(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Remove an upload and its parts; a missing upload is no error."""
        await self.threads.run(claims.robot, self.objects.abandon, claims, path["digest"])
        return HttpReply(status=204)

    async def list_maps(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Reply with the names of the tenant's maps, each with the id of its head."""
        maps = self._maps(claims)
        heads = await self.threads.run(claims.robot, maps.heads)
        return json_reply(200, MapPage(maps=[MapName(name=name, head=head) for name, head in heads.items()]))

    async def list_versions(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Reply with the records of all versions of a map, oldest first."""
        records = await self.threads.run(claims.robot, self._maps(claims).versions, path["name"])
        return json_reply(200, [MapVersionInfo(id=record.id, record=record) for record in records])

    async def commit_version(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Check that an object of this robot is a map, and make it the next version and the head of a map."""
        commit = await _json_body(request, Commit)
        if len(commit.note) > _MAX_NOTE_LETTERS:
            raise BadRequest(
                f"the note has {len(commit.note)} letters, at most {_MAX_NOTE_LETTERS}", hint="shorten it"
            )
        robot, source = claims.robot, self.objects.name(claims, commit.digest)
        size = (await self.threads.run(robot, self.objects.head, claims, commit.digest)).size
        summary = await self._map_threads.run(robot, self._describe, robot, source)

        def work() -> MapRecord:
            return self._maps(claims).commit_object(
                path["name"], source, summary, MapContent(commit.digest, size),
                MapOrigin(
                    parent=commit.parent, author=robot.name, created_s=self._wall_clock(), note=commit.note
                ),
                charged=functools.partial(self._charge, claims, path["name"]),
            )  # fmt: skip

        return _version(201, await self.threads.run(robot, work))

    @contextlib.contextmanager
    def _charge(self, claims: Claims, map_name: str, record: MapRecord, size: int) -> Iterator[None]:
        """Charge the *size* bytes of a version to its robot while the version is written.

        The charge stays if the version was stored, also if another version became the head meanwhile
        (Conflict).  It is removed if another error shows that nothing was stored.
        """
        charge = charge_name(claims.robot, map_name, record.id, size)
        with self.objects.reservation(claims, size):
            self._store.put(charge, b"")
            try:
                yield
            except Conflict:  # this version is stored, but another version is the head
                self.objects.accounts.forget(claims.robot)
                raise
            except BaseException:
                self._store.delete(charge)
                raise

    async def prune_versions(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Remove all versions of a map but the head and the newest ``keep``; allowed above a quota, too."""
        text = request.query.get("keep", "")
        keep = int(text) if _VERSION_COUNT.fullmatch(text) else 0
        if keep < 1:
            raise BadRequest(f"keep={text[:40]!r} is no number above 0", hint="say how many versions stay")

        def work() -> list[MapRecord]:
            maps = self._maps(claims)
            removed = maps.remove(path["name"], functools.partial(choose_superseded, keep=keep))
            tenant, accounts = claims.robot.tenant, self.objects.accounts
            accounts.forget_all(tenant)
            for record in removed:
                accounts.tenant(tenant).release(record.size)
            return removed

        removed = await self.threads.run(claims.robot, work)
        return json_reply(200, Pruned(removed=len(removed), freed_bytes=count_freed_bytes(removed)))

    async def show_version(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Reply with the record of a version; the version ``head`` is the current one."""
        read_record = self._maps(claims).record
        return _version(200, await self.threads.run(claims.robot, read_record, path["name"], path["version"]))

    async def get_version(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Reply with the file of a version of a map, or with the range of it that the request names."""
        maps = self._maps(claims)
        record = await self.threads.run(claims.robot, maps.record, path["name"], path["version"])
        return await self._content(
            request, claims.robot, maps.blob_name(path["name"], record), record.size, record.digest
        )

    async def move_head(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Make another version the head of a map, if the head still is the one that the robot expects."""
        move = await _json_body(request, MoveHead)
        maps = self._maps(claims)

        def work() -> MapRecord:
            return maps.move_head(path["name"], move.version, expected=move.expected)

        record = await self.threads.run(claims.robot, work)
        return _version(200, record)

    async def localise(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Reply with the pose of the body's photo in the head of a map; the query describes its lens."""
        lens = _lens(request.query)
        photo = await request.body(self._settings.part_bytes, hint="make the photo smaller")
        return await self._localiser_reply(claims.robot, self._localiser.localise, path["name"], photo, lens)

    async def outline(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Reply with the head of a map as seen from above: the outline that a web page draws."""
        return await self._localiser_reply(claims.robot, self._localiser.outline, path["name"])

    async def _localiser_reply(self, robot: RobotId, work: Callable[..., Any], *arguments: Any) -> HttpReply:
        """Call *work*, a method of the localiser, in a thread; reply with its result, charge its CPU time."""
        loop = asyncio.get_running_loop()

        def charge(cpu_s: float) -> None:
            with contextlib.suppress(RuntimeError):  # the event loop was closed: the server has stopped
                loop.call_soon_threadsafe(self._charge_cpu, robot, cpu_s)

        return json_reply(200, await self._photo_threads.run(robot, work, robot, *arguments, charge))

    def _maps(self, claims: Claims) -> MapRegistry:
        def record_change(action: str, name: str, record: MapRecord) -> None:
            if self._audit is not None:
                subject = str(RobotId(claims.robot.tenant, name))
                entry = Entry(
                    time=self._wall_clock(), actor=str(claims.robot), action=action, subject=subject,
                    detail={"version": record.id, "number": record.number},
                )  # fmt: skip
                self._audit.add([entry])

        return MapRegistry(self._store, claims.robot.tenant, on_change=record_change, check=check_wanted)

    async def _content(
        self,
        request: HttpRequest,
        robot: RobotId,
        name: str,
        size: int,
        digest: str,
        first: bytes | None = None,
    ) -> HttpReply:
        """Reply with the object *name* of *size* bytes, or with a range of it: 200, 206, 304, 307 or 416.

        *first* is the beginning of the object if the caller has read it already; None reads it here.
        """
        store, ttl_s = self._store, PRESIGNED_URL_TTL_S
        if not check_preconditions(request, digest):
            return HttpReply(status=304, headers=_content_headers(digest), media_type=BYTES)
        if request.headers.get("x-accept-direct") == "1" and isinstance(store, PresigningStore):
            url = await self.threads.run(robot, lambda: store.presigned_get(name, ttl_s=ttl_s))
            return HttpReply(status=307, headers={"Location": url, **_content_headers(digest)})
        try:
            text = request.headers.get("range") if wants_range(request, digest) else None
            part = requested_range(text, size)
        except BadRequest as error:
            refused = failure_reply(error)
            return HttpReply(status=416, body=refused.body, headers={"Content-Range": f"bytes */{size}"})
        start, end = part or (0, size)
        if first is None:  # read before the reply begins, so that an error of the store gets its own status
            first = await self._piece(robot, name, start, end)
        headers = {**_content_headers(digest), "Content-Length": str(end - start)}
        if part:
            headers["Content-Range"] = f"bytes {start}-{end - 1}/{size}"
        is_all = len(first) == end - start
        body = first if is_all else self._pieces(robot, name, first, start, end)
        return HttpReply(status=206 if part else 200, body=body, headers=headers, media_type=BYTES)

    async def _pieces(
        self, robot: RobotId, name: str, piece: bytes, start: int, end: int
    ) -> AsyncIterator[bytes]:
        coming: asyncio.Task[bytes] | None = None
        try:
            while start < end:
                start += len(piece)
                # The next piece is read while this one is sent.
                coming = asyncio.ensure_future(self._piece(robot, name, start, end))
                yield piece
                piece = await coming
        finally:
            if coming is not None:
                coming.cancel()

    async def _piece(self, robot: RobotId, name: str, start: int, end: int) -> bytes:
        """Read the bytes from *start* to *end*, at most `_PIECE_BYTES`; return b"" if *start* is at *end*.

        Raises:
            NotFound: The object was removed while it was read.
        """
        if start >= end:
            return b""
        length = min(_PIECE_BYTES, end - start)
        near = min(length, _CACHED_PIECE_BYTES)
        cached = None if self._cached is None else self._cached.get_cached(name, start, near)
        if cached is not None:
            piece = cached[1]
        else:
            piece = await self.threads.run(robot, self._store.get_range, name, start, length)
        if not piece:
            raise NotFound("the object was removed while it was read")
        return piece


def _content_headers(digest: str) -> dict[str, str]:
    return {
        "ETag": f'"{digest}"', "Accept-Ranges": "bytes", "Content-Disposition": "attachment",
        "X-Content-Type-Options": "nosniff",
    }  # fmt: skip


def _upload(status: int, state: Upload) -> HttpReply:
    return json_reply(status, state, {"Upload-Offset": str(state.offset)})


def _version(status: int, record: MapRecord) -> HttpReply:
    return json_reply(status, MapVersionInfo(id=record.id, record=record))


def _lens(query: Mapping[str, str]) -> PhotoLens:
    """Return the lens that the parameters of a query describe; raises BadRequest if they are not a lens."""
    values: dict[str, Any] = {name: text for name, text in query.items() if name in _LENS_PARAMETERS}
    values["distortion"] = [each for each in values.get("distortion", "").split(",") if each]
    try:
        return msgspec.convert(values, PhotoLens, strict=False)
    except msgspec.ValidationError as error:
        raise BadRequest(
            f"the query is not a lens: {error}", hint="write ?fx=525&fy=525&cx=319.5&cy=239.5, pixels"
        ) from error


async def _json_body(request: HttpRequest, kind: type[_T]) -> _T:
    raw: Any = await request.body(_MAX_JSON_BYTES)
    try:
        return msgspec.json.decode(raw, type=kind)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise BadRequest(f"the body is invalid: {error}", hint="see /data/openapi.json") from error
