"""Define what a robot receives for a command: a reply or a pose, who computed it, and how long it took."""

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
"""Who computed an answer: a backend server, the burst function (AWS Lambda), or the robot itself."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Origin:
    """Who computed an answer, and how long it took.

    Attributes:
        source: Who computed the answer.
        server: Name of the server, ``lambda`` for the burst function, or ``robot``.
        round_trip_ms: From the call to the answer, as the caller measured it.
        queue_ms: Time that the command waited on the server; 0 if *source* is not ``cloud``.
        compute_ms: Time of the computation.
        up_ms: Delay from robot to server; None if the offset of their clocks is unknown, or if *source* is
            not ``cloud``.
        down_ms: Delay from server to robot; None as for *up_ms*.
        payload_bytes: Size of the command's message; 0 if it was not sent.
        why: Why no server answered; empty if *source* is ``cloud``.
    """

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
    """The answer to a command: its reply, who computed it, and how long each step took in ms.

    A long service stores its reply as an object of the data service, too; ``object`` is its digest.  If the
    reply is too large for a message, ``reply`` is None, and
    ``decode_reply(DataClient(...).download(answer.object), ReplyType)`` returns the reply.
    """

    reply: Any
    object: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseAnswer(_Origin):
    """The answer to a pose command: the pose with its evidence; the other fields are those of `Answer`."""

    solution: PnpSolution

    @classmethod
    def of(cls, answer: Answer, solution: PnpSolution) -> PoseAnswer:
        """Return *solution*, the decoded reply of *answer*, with the source and the times of *answer*."""
        return cls(
            solution=solution, **{field.name: getattr(answer, field.name) for field in fields(_Origin)}
        )


def decode_reply(data: bytes, reply_type: type[T]) -> T:
    """Return the reply of a long service that was stored as an object.

    Args:
        data: Bytes of the object that ``Answer.object`` names.
        reply_type: Type of the service's reply, such as ``MergeReply``.

    Raises:
        BadMessage: *data* is no reply of that type.
    """
    try:
        plain = msgspec.msgpack.decode(data, ext_hook=extension_hook)
    except msgspec.DecodeError as error:
        raise BadMessage(
            "the data given to decode_reply are not a reply",
            hint="download the object that answer.object names",
        ) from error
    return as_type(plain, reply_type)
