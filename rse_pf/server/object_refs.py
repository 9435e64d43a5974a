"""Replace references to stored objects in a payload by their bytes before a service is called.

Where a request type declares ``bytes``, a robot may send ``{"object": DIGEST}`` instead, for an object that
it has stored in the data service.  A robot can refer only to its own objects: a missing object and an object
of another robot give the same error.  A service gets only bytes that match the digest.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import msgspec

from rse_pf.auth.tokens import Claims
from rse_pf.config import DataSettings
from rse_pf.errors import BadRequest, LimitExceeded, NotFound, QuotaExceeded, StoreError
from rse_pf.identity import RobotId, object_name
from rse_pf.server.robot_store import store_within_quota
from rse_pf.service import Registry, Service
from rse_pf.storage.object_store import ObjectStore, digest_of
from rse_pf.storage.quotas import Accounts
from rse_pf.wire import Command, Failure, Result
from rse_pf.wire.arrays import binary_encode_hook

__all__ = ["ObjectRefs", "named_in", "resolve", "takes_objects"]

_KEY = "object"  # the only key of the dict that is a reference
_DIGEST = re.compile(r"[0-9a-f]{64}")  # a sha256 in hexadecimal digits
MAX_OBJECTS_PER_COMMAND = 64  # different stored objects in one command: each costs two requests to the store
# Bytes of all stored objects of one command, and of a stored reply: a process holds them in memory.
MAX_OBJECT_BYTES_PER_COMMAND = 128 << 20
_MAX_DEPTH = 8  # nesting levels of a request type that are searched for ``bytes``: a type may contain itself


def takes_objects(request_type: type[Any]) -> bool:
    """Return whether *request_type* declares ``bytes`` in any field, where a robot may send a reference."""
    return _shape(request_type) is not None


def named_in(request_type: type[Any], payload: Any) -> list[str]:
    """Return the digest of each reference ``{"object": DIGEST}`` in *payload*, in order, with repetitions.

    Only such dicts in places where *request_type* declares ``bytes`` are references.

    Raises:
        BadRequest: A reference is not a dict of one key with a sha256 in hexadecimal digits.
    """
    return [_digest(reference) for reference in _references(_shape(request_type), payload)]


def resolve(
    request_type: type[Any],
    payload: Any,
    robot: RobotId,
    store: ObjectStore,
) -> Any:
    """Return *payload* with each reference ``{"object": DIGEST}`` replaced by the bytes of the stored object.

    This blocks on the store; a payload without references is returned unchanged, without a request to it.

    Args:
        request_type: The request type of the service, a msgspec Struct.
        payload: The payload of the command, decoded to plain dicts and lists; not changed.
        robot: The robot that the token names; only its own objects are read.
        store: The object store of the platform.

    Raises:
        BadRequest: A reference is not a dict of one key with a sha256 in hexadecimal digits.
        NotFound: The robot has no object of that digest, even if another robot has.
        LimitExceeded: More than `MAX_OBJECTS_PER_COMMAND` objects, or `MAX_OBJECT_BYTES_PER_COMMAND` in them.
        StoreError: The store fails, or the stored bytes do not match the digest.
    """
    digests = list(dict.fromkeys(named_in(request_type, payload)))
    if not digests:
        return payload
    if len(digests) > MAX_OBJECTS_PER_COMMAND:
        raise LimitExceeded(
            f"the command refers to {len(digests)} objects, above {MAX_OBJECTS_PER_COMMAND}",
            hint="put them into fewer commands",
        )
    size = sum(_size(store, object_name(robot, digest), digest) for digest in digests)
    if size > MAX_OBJECT_BYTES_PER_COMMAND:
        raise LimitExceeded(
            f"the objects have {size} bytes, above {MAX_OBJECT_BYTES_PER_COMMAND}",
            hint="put them into fewer commands",
        )
    held = {digest: _read(store, object_name(robot, digest), digest) for digest in digests}
    return _replace(_shape(request_type), payload, held.__getitem__)


@dataclass(frozen=True, slots=True)
class ObjectRefs:
    """Resolves references to stored objects, and stores large replies, for one worker.

    Without a store a payload with references is passed on unchanged, and a large reply is a failure.
    """

    store: ObjectStore | None
    data: DataSettings = field(default_factory=DataSettings)
    """The quotas of tenants, and of robots without a quota of their own."""

    def has_references(self, command: Command, service: Service) -> bool:
        """Return whether the payload of *command* refers to a stored object; always False without a store.

        For a service whose request type has no ``bytes`` the payload is not searched.
        """
        shape = None if self.store is None else _shape(service.request_type)
        return shape is not None and any(True for _ in _references(shape, command.payload))

    def resolve_references(self, command: Command, registry: Registry, robot: RobotId) -> Command:
        """Return *command* with stored objects in place of references to them; blocks on the store.

        Without a store, or without a reference, *command* itself is returned.

        Args:
            command: The decoded command; not changed.
            registry: Has the request type of the service.
            robot: The robot that sent the command; only its own objects are read.

        Raises:
            UnknownService: The registry has no service of that name.
            BadRequest: A reference is not a dict of one key with a sha256 in hexadecimal digits.
            NotFound: The robot has no object of that digest.
            LimitExceeded: The command refers to too many objects, or to too many bytes, see `resolve`.
            StoreError: The store fails, or the stored bytes do not match the digest.
        """
        service = registry.get(command.service)
        if self.store is None or not self.has_references(command, service):
            return command
        payload = resolve(service.request_type, command.payload, robot, self.store)
        return msgspec.structs.replace(command, payload=payload)

    def store_large_reply(
        self, result: Result, too_large: Failure, robot: RobotId, claims: Claims | None
    ) -> Result | Failure:
        """Store a reply that is too large for a message as an object of the robot; blocks on the store.

        Args:
            result: The result of the service, with the reply.
            too_large: The failure that is returned if the reply cannot be stored.
            robot: The robot; the stored reply counts for its quota.
            claims: The claims of the robot's token, which may hold the quota ``data_bytes``; None: no token.

        Returns:
            *result* without the reply and with the digest of the stored object.  *too_large* if there is no
            store, if the store fails, or if the reply has more than `MAX_OBJECT_BYTES_PER_COMMAND`.
            *too_large* with code, message and hint of QuotaExceeded if the reply exceeds the quota of the
            robot or of its tenant.
        """
        if self.store is None:
            return too_large
        reply = msgspec.msgpack.encode(result.reply, enc_hook=binary_encode_hook)
        if len(reply) > MAX_OBJECT_BYTES_PER_COMMAND:
            return too_large
        max_bytes = None if claims is None else claims.quota("data_bytes")
        accounts = Accounts(self.store, self.data)
        try:
            digest = store_within_quota(self.store, accounts, robot, reply, max_bytes)
        except QuotaExceeded as error:
            return msgspec.structs.replace(too_large, code=error.code, message=error.message, hint=error.hint)
        except StoreError:
            return too_large
        return msgspec.structs.replace(result, reply=None, object=digest)


# --- The shape of a request type: the places where it declares bytes, so that references may stand there ---


@dataclass(frozen=True, slots=True)
class _Bytes:
    """Shape of a place where the request type declares ``bytes``: a reference may stand there."""


@dataclass(frozen=True, slots=True)
class _Each:
    """Shape of a list or a dict: each item, or each value, has the shape *below*."""

    below: Any


@dataclass(frozen=True, slots=True)
class _Fields:
    """Shape of a struct: *below* has the shapes of those fields that contain ``bytes``, by field name."""

    below: dict[str, Any]


def _shape(request_type: Any) -> Any:
    """Return the places where *request_type* declares ``bytes``; None if it declares none.

    They are described by a shape, a tree of `_Bytes`, `_Each` and `_Fields`, which is made once for a type.
    """
    return _cached_shape(request_type)


@functools.lru_cache(maxsize=1024)
def _cached_shape(request_type: type[Any]) -> Any:
    return _shape_of(msgspec.inspect.type_info(request_type), _MAX_DEPTH)


def _shape_of(kind: Any, depth: int) -> Any:
    """Return the places of ``bytes`` in the msgspec type *kind* as a shape (see `_shape`).

    Only *depth* levels of nested types are searched; the result is None if they contain no ``bytes``.  A
    union has the shape of its only member with ``bytes``, and None if several members have ``bytes``.
    """
    known = msgspec.inspect
    if depth == 0:
        return None
    if isinstance(kind, known.BytesType):
        return _Bytes()
    if isinstance(kind, known.Metadata):
        return _shape_of(kind.type, depth)
    if isinstance(kind, known.UnionType):
        shapes = [shape for member in kind.types if (shape := _shape_of(member, depth)) is not None]
        return shapes[0] if len(shapes) == 1 else None
    if isinstance(kind, (known.ListType, known.VarTupleType, known.DictType)):
        item = kind.value_type if isinstance(kind, known.DictType) else kind.item_type
        below = _shape_of(item, depth - 1)
        return None if below is None else _Each(below)
    if isinstance(kind, (known.StructType, known.DataclassType)):
        fields = {field.encode_name: _shape_of(field.type, depth - 1) for field in kind.fields}
        fields = {name: shape for name, shape in fields.items() if shape is not None}
        return _Fields(fields) if fields else None
    return None


def _references(shape: Any, value: Any) -> Iterator[dict[str, Any]]:
    """Yield each dict with the key ``object`` that *value* has in a place where *shape* has ``bytes``."""
    if isinstance(shape, _Bytes):
        if isinstance(value, dict) and _KEY in value:
            yield value
    elif isinstance(shape, _Each) and isinstance(value, (list, tuple, dict)):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _references(shape.below, item)
    elif isinstance(shape, _Fields) and isinstance(value, dict):
        for name, below in shape.below.items():
            if name in value:
                yield from _references(below, value[name])


def _replace(shape: Any, value: Any, read: Callable[[Any], Any]) -> Any:
    """Return a copy of *value* with `read(digest)` in each place of *shape* that has a reference.

    Parts in which the request type has no ``bytes`` are not copied.
    """
    if isinstance(shape, _Bytes):
        return read(_digest(value)) if isinstance(value, dict) and _KEY in value else value
    if isinstance(shape, _Each) and isinstance(value, dict):
        return {key: _replace(shape.below, item, read) for key, item in value.items()}
    if isinstance(shape, _Each) and isinstance(value, (list, tuple)):
        return [_replace(shape.below, item, read) for item in value]
    if isinstance(shape, _Fields) and isinstance(value, dict):
        below = shape.below
        return {
            key: _replace(below[key], item, read) if key in below else item for key, item in value.items()
        }
    return value


def _digest(value: dict[str, Any]) -> str:
    """Return the digest in the reference *value*; raises BadRequest."""
    digest = value[_KEY]
    if len(value) != 1 or not isinstance(digest, str) or not _DIGEST.fullmatch(digest):
        raise BadRequest(
            "the payload has an invalid reference to a stored object",
            hint='write {"object": "..."} with the sha256 of the object, 64 lower-case hexadecimal digits',
        )
    return digest


def _size(store: ObjectStore, name: str, digest: str) -> int:
    try:
        return store.head(name).size
    except NotFound:
        raise _missing(digest) from None


def _read(store: ObjectStore, name: str, digest: str) -> bytes:
    try:
        data = store.get(name)
    except NotFound:
        raise _missing(digest) from None
    if digest_of(data) != digest:
        raise StoreError(
            "the stored bytes do not match the digest of the object", hint="store the object again"
        )
    return data


def _missing(digest: str) -> NotFound:
    return NotFound(f"this robot has no object {digest[:16]}...", hint="upload it to the data service first")
