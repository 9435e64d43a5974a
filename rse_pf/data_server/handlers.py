"""The handlers of the data service, one for each route; calls of the store run in a thread.

Tenant and robot come only from the token, and an object of another robot is reported as missing.
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
# Gets a request, the claims of its token, and the parameters of its path.
Handler = Callable[[HttpRequest, Claims, dict[str, str]], Awaitable[HttpReply]]

_PIECE_BYTES = 1 << 20  # of an object, read at once by a thread
_CACHED_PIECE_BYTES = 1 << 19  # of an object, copied at once by the event loop from memory
_MAX_JSON_BYTES = 16384  # of a request body in JSON; the longest has a note of 500 letters
_MAX_NOTE_LETTERS = 500  # of the note of a version
_MAX_PAGE = 1000  # objects in one page of a list, as many as S3 lists at once
PRESIGNED_URL_TTL_S = 300  # validity of a presigned URL: long enough to begin one transfer
_BEGINNING = re.compile(r"[0-9a-f]{0,64}")
_MAP_THREADS = 1  # it waits for the process that reads maps, so that slow maps delay only other maps
_PROBE = "ready/probe"
_LENS = frozenset(PhotoLens.__struct_fields__)
_COUNT = re.compile(r"[0-9]{1,6}")


@dataclass(frozen=True, slots=True)
class MapWork:
    """The functions that read maps.

    Attributes:
        describe: Returns the summary of the map in an object, given its robot and its name.
        localiser: Localises photos in maps.
        charge: Counts CPU seconds of a robot's photo.
    """

    describe: Callable[[RobotId, str], MapSummary]
    localiser: PhotoLocaliser
    charge: Callable[[RobotId, float], None]


class Handlers:
    """One method for each operation of `rse_pf.data_server.routes`."""

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
        """Make the handlers; *map_work* is done in threads of its own, and closed elsewhere."""
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
        """End the threads when their work is done."""
        self.threads.close()
        self._map_threads.close()
        self._photo_threads.close()

    async def healthz(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Return 200."""
        return json_reply(200, ServiceHealth(status="ok"))

    async def readyz(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Ask the store for a missing object; any other error than NotFound means not ready."""
        with contextlib.suppress(NotFound):
            await asyncio.to_thread(self._store.head, _PROBE)
        return json_reply(200, ServiceHealth(status="ready"))

    async def document(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Return the OpenAPI document."""
        return HttpReply(status=200, body=self._document)

    async def list_objects(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """List a page of objects."""
        text = request.query.get("limit", str(_MAX_PAGE))
        limit = int(text) if text.isdecimal() and text.isascii() and len(text) < 6 else 0
        if not 1 <= limit <= _MAX_PAGE:
            raise BadRequest(f"limit {text[:40]!r} is not in 1 to {_MAX_PAGE}", hint="leave it out")
        after = request.query.get("after", "")
        if not _BEGINNING.fullmatch(after):
            raise BadRequest(f"after={after[:80]!r} begins no digest", hint="use next of the page before")
        listed, more = await self.threads.run(claims.robot, self.objects.list, claims, after, limit)
        page = [StoredObject(digest=info.name.rpartition("/")[2], size=info.size) for info in listed]
        return json_reply(200, ObjectPage(objects=page, next=page[-1].digest if more else None))

    async def get_object(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Return an object or a range of it."""
        digest = path["digest"]
        name = self.objects.name(claims, digest)
        if self._cached is not None and "range" not in request.headers:
            cached = self._cached.get_cached(name, 0, _CACHED_PIECE_BYTES)
            if cached is not None:  # a thread would take longer to be asked
                return await self._content(request, claims.robot, name, cached[0], digest, cached[1])
        return await self._content(request, claims.robot, *await self._head(claims, digest), digest)

    async def head_object(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Return the size."""
        _, size = await self._head(claims, path["digest"])
        headers = _content_headers(path["digest"])
        if not check_preconditions(request, path["digest"]):
            return HttpReply(status=304, headers=headers, media_type=BYTES)
        return HttpReply(status=200, headers={**headers, "Content-Length": str(size)}, media_type=BYTES)

    async def _check_change(self, request: HttpRequest, claims: Claims, digest: str) -> None:
        """Check name and conditions of a change; raises BadRequest or PreconditionFailed."""
        self.objects.name(claims, digest)
        if has_conditions(request):
            tag: str | None = digest
            try:
                await self._head(claims, digest)
            except NotFound:
                tag = None
            check_preconditions(request, tag)

    async def _head(self, claims: Claims, digest: str) -> tuple[str, int]:
        """Return name and size of an object; raises NotFound."""
        name = self.objects.name(claims, digest)
        cached = None if self._cached is None else self._cached.get_cached(name, 0, 0)
        if cached is not None:
            return name, cached[0]
        info = await self.threads.run(claims.robot, self.objects.head, claims, digest)
        return info.name, info.size

    async def put_object(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Store a small object."""
        await self._check_change(request, claims, path["digest"])
        data = await request.body(self._settings.part_bytes)
        new = await self.threads.run(claims.robot, self.objects.put, claims, path["digest"], data)
        return json_reply(201 if new else 200, StoredObject(digest=path["digest"], size=len(data)))

    async def delete_object(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Remove an object."""
        await self._check_change(request, claims, path["digest"])
        await self.threads.run(claims.robot, self.objects.delete, claims, path["digest"])
        return HttpReply(status=204)

    async def begin_upload(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Open an upload."""
        begin = await _json_body(request, UploadBegin)
        if begin.size < 1:
            raise BadRequest(f"a size of {begin.size} bytes needs no upload", hint="PUT the object")
        state = await self.threads.run(claims.robot, self.objects.begin, claims, path["digest"], begin.size)
        direct = await self.threads.run(claims.robot, self._presigned_put, claims, state)
        return _upload(200, msgspec.structs.replace(state, direct=direct))

    def _presigned_put(self, claims: Claims, state: Upload) -> PresignedPut | None:
        """Return a URL for a direct upload; None if a part is stored, or the store presigns none."""
        store, ttl_s = self._store, PRESIGNED_URL_TTL_S
        if state.offset or not isinstance(store, PresigningStore):
            return None
        name = self.objects.name(claims, state.digest)
        url, headers = store.presigned_put(name, size=state.size, sha256=state.digest, ttl_s=ttl_s)
        return PresignedPut(url=url, headers=headers, life_s=ttl_s)

    async def get_upload(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Return the state of an upload."""
        return _upload(
            200, await self.threads.run(claims.robot, self.objects.progress, claims, path["digest"])
        )

    head_upload = get_upload

    async def append_part(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Store a part."""
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
        """Remove an upload."""
        await self.threads.run(claims.robot, self.objects.abandon, claims, path["digest"])
        return HttpReply(status=204)

    async def list_maps(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """List maps with their heads."""
        maps = self._maps(claims)

        heads = await self.threads.run(claims.robot, maps.heads)
        return json_reply(200, MapPage(maps=[MapName(name=name, head=head) for name, head in heads.items()]))

    async def list_versions(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """List versions."""
        records = await self.threads.run(claims.robot, self._maps(claims).versions, path["name"])
        return json_reply(200, [MapVersionInfo(id=record.id, record=record) for record in records])

    async def commit_version(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Commit an object of this robot as a version."""
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
        """Charge a robot with a version while it is written; not if nothing of it was stored."""
        charge = charge_name(claims.robot, map_name, record.id, size)
        with self.objects.reservation(claims, size):
            self._store.put(charge, b"")
            try:
                yield
            except Conflict:  # the version is stored, another one is the head
                self.objects.accounts.forget(claims.robot)
                raise
            except BaseException:
                self._store.delete(charge)
                raise

    async def prune_versions(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Remove old versions, above every quota, too."""
        text = request.query.get("keep", "")
        keep = int(text) if _COUNT.fullmatch(text) else 0
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
        """Show a version."""
        read_record = self._maps(claims).record
        return _version(200, await self.threads.run(claims.robot, read_record, path["name"], path["version"]))

    async def get_version(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Return the bytes of a version or a range of them."""
        maps = self._maps(claims)
        record = await self.threads.run(claims.robot, maps.record, path["name"], path["version"])
        return await self._content(
            request, claims.robot, maps.blob_name(path["name"], record), record.size, record.digest
        )

    async def move_head(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Move a head."""
        move = await _json_body(request, MoveHead)

        maps = self._maps(claims)

        def work() -> MapRecord:
            return maps.move_head(path["name"], move.version, expected=move.expected)

        record = await self.threads.run(claims.robot, work)
        return _version(200, record)

    async def localise(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Localise a photo."""
        lens = _lens(request.query)
        photo = await request.body(self._settings.part_bytes, hint="make the photo smaller")
        return await self._of_map(claims.robot, self._localiser.localise, path["name"], photo, lens)

    async def outline(self, request: HttpRequest, claims: Claims, path: dict[str, str]) -> HttpReply:
        """Return a map from above."""
        return await self._of_map(claims.robot, self._localiser.outline, path["name"])

    async def _of_map(self, robot: RobotId, work: Callable[..., Any], *arguments: Any) -> HttpReply:
        loop = asyncio.get_running_loop()

        def charge(cpu_s: float) -> None:
            with contextlib.suppress(RuntimeError):  # the loop was closed
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
        """Reply with an object or a range of it; *first* is the first piece of the whole, if it is known."""
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
        if first is None:  # an error is answered as one, before the header
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
                coming = asyncio.ensure_future(self._piece(robot, name, start, end))  # while this one is sent
                yield piece
                piece = await coming
        finally:
            if coming is not None:
                coming.cancel()

    async def _piece(self, robot: RobotId, name: str, start: int, end: int) -> bytes:
        """Return the bytes from *start* on, at most `_PIECE_BYTES`; none if there are none before *end*."""
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
    """Return the lens that a query describes; raises BadRequest."""
    values: dict[str, Any] = {name: text for name, text in query.items() if name in _LENS}
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
