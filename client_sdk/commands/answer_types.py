"""The answers that a robot receives: a reply or a pose, who computed it, and where the time went."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import msgspec

from rse_pf.errors import BadMessage
from rse_pf.wire import as_type
from rse_pf.wire.arrays import extension_hook

if TYPE_CHECKING:
    from rse_pf.pnp import PnpSolution

__all__ = ["Answer", "PoseAnswer", "Source", "decode_reply"]

T = TypeVar("T")

Source = Literal["cloud", "burst", "robot"]
"""A server, the burst function, or the robot itself."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Origin:
    """Who answered, and where the time went (ms; None if unknown); ``why`` is empty for the cloud."""

    source: Source
    server: str
    round_trip_ms: float
    queue_ms: float
    compute_ms: float
    up_ms: float | None = None
    down_ms: float | None = None
    payload_bytes: int = 0
    why: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer(_Origin):
    """A reply, who computed it, and where the time went (ms; None if unknown).

    If *source* is ``burst`` or ``robot``, ``why`` says why no server answered.  ``object`` is the digest of
    a reply that is stored as an object (of long services); if it is too large for a message, ``reply`` is
    None, and ``decode_reply(DataClient(...).download(answer.object), ReplyType)`` returns it.
    """

    reply: Any
    object: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseAnswer(_Origin):
    """A pose with its evidence; the other fields are those of `Answer`."""

    solution: PnpSolution

    @classmethod
    def of(cls, answer: Answer, solution: PnpSolution) -> PoseAnswer:
        """Return *solution* with the origin of *answer*, whose reply it was."""
        return cls(
            solution=solution, **{field.name: getattr(answer, field.name) for field in fields(_Origin)}
        )


def decode_reply(data: bytes, reply_type: type[T]) -> T:
    """Return the reply that was stored as an object; raises BadMessage if *data* is not of that type."""
    try:
        plain = msgspec.msgpack.decode(data, ext_hook=extension_hook)
    except msgspec.DecodeError as error:
        raise BadMessage("this object is not a reply", hint="download what answer.object names") from error
    return as_type(plain, reply_type)
