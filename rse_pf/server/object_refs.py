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

_KEY = "object"
_DIGEST = re.compile(r"[0-9a-f]{64}")
MAX_OBJECTS_PER_COMMAND = 64  # stored objects in one command: each costs a request to the store
MAX_OBJECT_BYTES_PER_COMMAND = 128 << 20  # all objects of one command: its process holds them in memory
_MAX_DEPTH = 8  # levels of a request type in which references are looked for; recursive types end there


def takes_objects(request_type: type[Any]) -> bool:
    """Return whether *request_type* declares ``bytes`` anywhere, so that a reference may stand there."""
    return _shape(request_type) is not None


def named_in(request_type: type[Any], payload: Any) -> list[str]:
    """Return the digests that *payload* refers to where *request_type* declares ``bytes``, in order.

    Raises:
        BadRequest: A reference there is no sha256 in hex.
    """
    return [_digest(reference) for reference in _references(_shape(request_type), payload)]


def resolve(
    request_type: type[Any],
    payload: Any,
    robot: RobotId,
    store: ObjectStore,
) -> Any:
    """Return *payload* with the robot's own objects in the place of the references; blocks on the store.

    A payload without references is returned as it is, and the store is not asked.

    Args:
        request_type: What the service takes, a msgspec Struct.
        payload: As decoded from the wire: plain dicts and lists; not changed.
        robot: The robot that the token names.
        store: The store of the platform.

    Raises:
        BadRequest: A reference is no sha256 in hex.
        NotFound: The robot has no such object; another one may have.
        LimitExceeded: More objects, or bytes in them, than one command may refer to.
        StoreError: The store fails, or holds other bytes than the digest says.
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
    """The store and limits of one worker; without a store, references are not resolved."""

    store: ObjectStore | None
    data: DataSettings = field(default_factory=DataSettings)
    """Quotas of tenants, and of robots whose tokens name none."""

    def has_references(self, command: Command, service: Service) -> bool:
        """Return whether *command* refers to stored objects; cheap for services that take no ``bytes``.

        Without a store, no reference is looked for.
        """
        shape = None if self.store is None else _shape(service.request_type)
        return shape is not None and any(True for _ in _references(shape, command.payload))

    def resolve_references(self, command: Command, registry: Registry, robot: RobotId) -> Command:
        """Return *command* with the bytes that its payload refers to; blocks on the store.

        Args:
            command: As decoded from the wire; not changed.
            registry: Knows the request type of the service.
            robot: Whose own objects alone are read.

        Raises:
            UnknownService: The registry does not know the service.
            BadRequest: A reference is no sha256 in hex.
            NotFound: The robot has no such object.
            LimitExceeded: The command refers to more objects, or bytes in them, than it may.
            StoreError: The store fails, or holds other bytes than the digest says.
        """
        service = registry.get(command.service)
        if self.store is None or not self.has_references(command, service):
            return command
        payload = resolve(service.request_type, command.payload, robot, self.store)
        return msgspec.structs.replace(command, payload=payload)

    def store_large_reply(
        self, result: Result, too_large: Failure, robot: RobotId, claims: Claims | None
    ) -> Result | Failure:
        """Store the reply of *result*, which is too large for a message; blocks on the store.

        Args:
            result: Of the service.
            too_large: The failure that the robot gets if the reply cannot be stored.
            robot: Whose quota the stored reply counts for.
            claims: Of its token, which may name the quota.

        Returns:
            *result* with the digest of the stored reply instead of the reply; *too_large* if there is no
            store, if it fails, or if the reply is too large for it as well; the failure of the quota if the
            reply is beyond that of the robot or of its tenant.
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


# --- where references may stand -----------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Bytes:
    """A reference may stand here."""


@dataclass(frozen=True, slots=True)
class _Each:
    """References may stand in each item of a list, or in each value of a dict."""

    below: Any


@dataclass(frozen=True, slots=True)
class _Fields:
    """References may stand in these fields of a struct."""

    below: dict[str, Any]


def _shape(request_type: Any) -> Any:
    return _cached_shape(request_type)


@functools.lru_cache(maxsize=1024)
def _cached_shape(request_type: type[Any]) -> Any:
    return _shape_of(msgspec.inspect.type_info(request_type), _MAX_DEPTH)


def _shape_of(kind: Any, depth: int) -> Any:
    """Return the places below *kind* where bytes are declared, None if there are none."""
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
    """Yield each dict in *value* that has the form of a reference and stands where *shape* has bytes."""
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
    """Return *value* with `read(digest)` in the place of each reference; unchanged parts are shared."""
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
    digest = value[_KEY]
    if len(value) != 1 or not isinstance(digest, str) or not _DIGEST.fullmatch(digest):
        raise BadRequest(
            "this is no reference to an object",
            hint='write {"object": "..."} with the sha256, 64 small hex digits',
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
        raise StoreError("the bytes are not those of the digest", hint="store the object again")
    return data


def _missing(digest: str) -> NotFound:
    return NotFound(f"this robot has no object {digest[:16]}...", hint="upload it to the data service first")
