"""The orders that a supervisor sends to its workers, each as one line of JSON on the control channel."""

from __future__ import annotations

import msgspec

from rse_pf.identity import RobotId

__all__ = [
    "BanOrder", "BeginOrder", "BlocksOrder", "DrainOrder", "LeaveOrder", "MigrateOrder",
    "ReloadServicesOrder", "ReplaceOrder", "ReportOrder", "RobotsOrder", "TrustOrder", "UnblockOrder",
    "WorkerOrder", "decode_order", "encode_order",
]  # fmt: skip


class ReportOrder(msgspec.Struct, tag="report", tag_field="do", frozen=True):
    """Send the metrics of the worker to the supervisor."""


class DrainOrder(msgspec.Struct, tag="drain", tag_field="do", frozen=True):
    """Ask every robot to move to another server within *within_ms*, and report when all have left."""

    within_ms: float


class MigrateOrder(msgspec.Struct, tag="migrate", tag_field="do", frozen=True):
    """After each of *delays_s* (seconds), ask one robot to move to another server within *within_ms*."""

    delays_s: list[float]
    within_ms: float


class TrustOrder(msgspec.Struct, tag="trust", tag_field="do", frozen=True):
    """Verify tokens by *snapshot*: keys, roster and deny list as a `TrustStore` encodes them."""

    snapshot: str


class ReplaceOrder(msgspec.Struct, tag="replace", tag_field="do", frozen=True):
    """Close the connection *number*, because its robot has a newer connection to this server."""

    number: int


class BlocksOrder(msgspec.Struct, tag="blocks", tag_field="do", frozen=True):
    """Send a list of the services and requests refused after crashes; the answer has this *number*."""

    number: int


class RobotsOrder(msgspec.Struct, tag="robots", tag_field="do", frozen=True):
    """Send a list of the connected robots; the answer has this *number*."""

    number: int


class UnblockOrder(msgspec.Struct, tag="unblock", tag_field="do", frozen=True):
    """Lift refusals after crashes, and send a list of those that were lifted; the answer has this *number*.

    *service*, *tenant* and *robot* select refusals; None selects all services, tenants, or robots of the
    tenant.
    """

    number: int
    service: str | None = None
    tenant: str | None = None
    robot: str | None = None


class ReloadServicesOrder(msgspec.Struct, tag="reload-services", tag_field="do", frozen=True):
    """Load the services folder again; if that fails, log it and keep the present services."""


class BanOrder(msgspec.Struct, tag="ban", tag_field="do", frozen=True):
    """Disconnect *robot*, and reject its handshakes for *seconds*."""

    robot: RobotId
    seconds: float


class BeginOrder(msgspec.Struct, tag="begin", tag_field="do", frozen=True):
    """Take the place of a crashed worker; the first order to a spare process.

    Attributes:
        index: Index of the crashed worker, which the spare process gets.
        wait_s: Seconds for which the spare process waits before it serves robots.
        snapshot: Keys, roster and deny list as a `TrustStore` encodes them; "" for those with which the
            server started.
        banned: Robots whose handshakes are rejected, each with the number of seconds.
    """

    index: int
    wait_s: float
    snapshot: str
    banned: list[tuple[RobotId, float]]


class LeaveOrder(msgspec.Struct, tag="leave", tag_field="do", frozen=True):
    """Wait at most *held_s* seconds until all commands are answered, close every socket, and exit."""

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
    """Return *order* as a line of JSON, with a newline."""
    return msgspec.json.encode(order) + b"\n"


def decode_order(line: bytes) -> WorkerOrder:
    """Return the order in *line*; raises msgspec.ValidationError if *line* is no order."""
    return _DECODER.decode(line)
