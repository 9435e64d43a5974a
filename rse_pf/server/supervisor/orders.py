"""What a supervisor orders its workers to do: one JSON line each on the control channel."""

from __future__ import annotations

import msgspec

from rse_pf.identity import RobotId

__all__ = [
    "BanOrder", "BeginOrder", "BlocksOrder", "DrainOrder", "LeaveOrder", "MigrateOrder",
    "ReloadServicesOrder", "ReplaceOrder", "ReportOrder", "RobotsOrder", "TrustOrder", "UnblockOrder",
    "WorkerOrder", "decode_order", "encode_order",
]  # fmt: skip


class ReportOrder(msgspec.Struct, tag="report", tag_field="do", frozen=True):
    """Report the metrics."""


class DrainOrder(msgspec.Struct, tag="drain", tag_field="do", frozen=True):
    """Ask every robot to move within *within_ms*, and tell when all are gone."""

    within_ms: float


class MigrateOrder(msgspec.Struct, tag="migrate", tag_field="do", frozen=True):
    """Ask one robot after each of *delays_s* to move within *within_ms*."""

    delays_s: list[float]
    within_ms: float


class TrustOrder(msgspec.Struct, tag="trust", tag_field="do", frozen=True):
    """Trust what *snapshot*, the text of a `TrustStore`, says from now on."""

    snapshot: str


class ReplaceOrder(msgspec.Struct, tag="replace", tag_field="do", frozen=True):
    """End the *number*-th socket: its robot has a newer one."""

    number: int


class BlocksOrder(msgspec.Struct, tag="blocks", tag_field="do", frozen=True):
    """Order an answer with this *number* that lists the blocks of circuit breakers and poison requests."""

    number: int


class RobotsOrder(msgspec.Struct, tag="robots", tag_field="do", frozen=True):
    """Order an answer with this *number* that lists the connected robots."""

    number: int


class UnblockOrder(msgspec.Struct, tag="unblock", tag_field="do", frozen=True):
    """Lift what is refused, and tell in an answer with this *number* what it was.

    None stands for every service, everybody, and every robot of the tenant.
    """

    number: int
    service: str | None = None
    tenant: str | None = None
    robot: str | None = None


class ReloadServicesOrder(msgspec.Struct, tag="reload-services", tag_field="do", frozen=True):
    """Load the services folder anew; what cannot be loaded changes nothing, and the log says why."""


class BanOrder(msgspec.Struct, tag="ban", tag_field="do", frozen=True):
    """Disconnect *robot*, and refuse it for *seconds*."""

    robot: RobotId
    seconds: float


class BeginOrder(msgspec.Struct, tag="begin", tag_field="do", frozen=True):
    """Take the place of worker *index*, which has crashed; the first order of a process that waits for one.

    It begins after *wait_s*.  ``snapshot`` is the text of a `TrustStore`, "" for the keys of the server's
    start; each robot in ``banned`` is refused for its number of seconds from then on.
    """

    index: int
    wait_s: float
    snapshot: str
    banned: list[tuple[RobotId, float]]


class LeaveOrder(msgspec.Struct, tag="leave", tag_field="do", frozen=True):
    """Wait at most *held_s* for commands that are held, close every socket, and end."""

    held_s: float


WorkerOrder = (
    ReportOrder
    | BanOrder
    | BeginOrder
    | DrainOrder
    | MigrateOrder
    | TrustOrder
    | ReplaceOrder
    | BlocksOrder
    | RobotsOrder
    | UnblockOrder
    | ReloadServicesOrder
    | LeaveOrder
)

_DECODER: msgspec.json.Decoder[WorkerOrder] = msgspec.json.Decoder(WorkerOrder)


def encode_order(order: WorkerOrder) -> bytes:
    """Return the line that carries *order*."""
    return msgspec.json.encode(order) + b"\n"


def decode_order(line: bytes) -> WorkerOrder:
    """Return the order of a line; raises msgspec.ValidationError for one that is none."""
    return _DECODER.decode(line)
