"""Orders to a worker."""

from __future__ import annotations

import msgspec
import pytest

from rse_pf.backend.supervisor.orders import (
    BlocksOrder,
    DrainOrder,
    LeaveOrder,
    MigrateOrder,
    ReplaceOrder,
    ReportOrder,
    RobotsOrder,
    TrustOrder,
    UnblockOrder,
    WorkerOrder,
    decode_order,
    encode_order,
)


@pytest.mark.parametrize(
    "order",
    [
        ReportOrder(), DrainOrder(200.0), MigrateOrder([0.1, 0.5], 200.0), TrustOrder('{"keys": "a\\nb"}'),
        ReplaceOrder(7), LeaveOrder(0.5), BlocksOrder(1), RobotsOrder(4), UnblockOrder(2),
        UnblockOrder(3, "icp", "a", "b\n"),
    ],
)  # fmt: skip
def test_an_order_travels_as_one_line(order: WorkerOrder) -> None:
    line = encode_order(order)

    assert line.endswith(b"\n")
    assert line.count(b"\n") == 1
    assert decode_order(line) == order


@pytest.mark.parametrize("line", [b"{}", b'{"do": "dance"}', b'{"do": "replace"}', b"nonsense"])
def test_a_line_that_is_no_order_is_refused(line: bytes) -> None:
    with pytest.raises(msgspec.DecodeError):
        decode_order(line)
