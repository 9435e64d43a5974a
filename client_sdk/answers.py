"""What a robot gets back: a reply, a pose, and how they came.

Promises to hold values and how to read them, nothing that waits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import msgspec

from rse_pf.errors import BadMessage
from rse_pf.wire import as_type
from rse_pf.wire.arrays import extension_hook

if TYPE_CHECKING:
    from rse_pf.pnp import PnpSolution

__all__ = ["Answer", "PoseAnswer", "Source", "decode_reply"]

T = TypeVar("T")

Source = Literal["cloud", "robot"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """A reply and how it came: who answered, and where the time went (ms; None if unknown).

    ``why`` says, if *source* is ``robot``, why the cloud did not answer.  ``object`` is the digest of a reply
    that is kept as an object (of long services); where it is too large for a message, ``reply`` is None, and
    ``decode_reply(DataClient(...).download(answer.object), ReplyType)`` gives it.
    """

    reply: Any
    source: Source
    server: str
    round_trip_ms: float
    queue_ms: float
    compute_ms: float
    up_ms: float | None = None
    down_ms: float | None = None
    payload_bytes: int = 0
    why: str = ""
    object: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseAnswer:
    """A pose with its evidence, and how it came; the fields are those of `Answer`."""

    solution: PnpSolution
    source: Source
    server: str
    round_trip_ms: float
    queue_ms: float
    compute_ms: float
    up_ms: float | None = None
    down_ms: float | None = None
    payload_bytes: int = 0
    why: str = ""


def decode_reply(data: bytes, reply_type: type[T]) -> T:
    """Return the reply that was kept as an object; raises BadMessage if *data* is none of that type."""
    try:
        plain = msgspec.msgpack.decode(data, ext_hook=extension_hook)
    except msgspec.DecodeError as error:
        raise BadMessage("this object is no reply", hint="download what answer.object names") from error
    return as_type(plain, reply_type)
