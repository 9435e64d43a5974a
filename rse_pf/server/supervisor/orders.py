"""The orders of a supervisor to its workers: one JSON line each on the control channel."""

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
    """Ask every robot to move within *within_ms*, and report when all have left."""

    within_ms: float


class MigrateOrder(msgspec.Struct, tag="migrate", tag_field="do", frozen=True):
    """Ask one robot after each of *delays_s* to move within *within_ms*."""

    delays_s: list[float]
    within_ms: float


class TrustOrder(msgspec.Struct, tag="trust", tag_field="do", frozen=True):
    """Verify tokens by *snapshot*, the text of a `TrustStore`, from now on."""

    snapshot: str


class ReplaceOrder(msgspec.Struct, tag="replace", tag_field="do", frozen=True):
    """Close the connection *number*: its robot has a newer one."""

    number: int


class BlocksOrder(msgspec.Struct, tag="blocks", tag_field="do", frozen=True):
    """List the services and requests that are refused after crashes, in an answer with this *number*."""

    number: int


class RobotsOrder(msgspec.Struct, tag="robots", tag_field="do", frozen=True):
    """List the connected robots, in an answer with this *number*."""

    number: int


class UnblockOrder(msgspec.Struct, tag="unblock", tag_field="do", frozen=True):
    """Lift refusals after crashes, and list them in an answer with this *number*.

    None stands for every service, every tenant, and every robot of the tenant.
    """

    number: int
    service: str | None = None
    tenant: str | None = None
    robot: str | None = None


class ReloadServicesOrder(msgspec.Struct, tag="reload-services", tag_field="do", frozen=True):
    """Load the services folder again; if that fails, the services stay as they are, and it is logged."""


class BanOrder(msgspec.Struct, tag="ban", tag_field="do", frozen=True):
    """Disconnect *robot*, and refuse it for *seconds*."""

    robot: RobotId
    seconds: float


class BeginOrder(msgspec.Struct, tag="begin", tag_field="do", frozen=True):
    """Take the place of worker *index*, which has crashed: the first order to a spare process.

    Attributes:
        index: The index of the worker.
        wait_s: Seconds to wait before it begins.
        snapshot: The text of a `TrustStore`; "" for the keys with which the server started.
        banned: Robots that are refused, each with the number of seconds.
    """

    index: int
    wait_s: float
    snapshot: str
    banned: list[tuple[RobotId, float]]


class LeaveOrder(msgspec.Struct, tag="leave", tag_field="do", frozen=True):
    """Wait at most *held_s* until the commands that are held are answered, close every socket, and exit."""

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
    """Return the order in *line*; raises msgspec.ValidationError if there is none."""
    return _DECODER.decode(line)
