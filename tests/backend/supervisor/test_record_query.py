"""Who may have requests recorded, and how many."""

from __future__ import annotations

import pytest

from rse_pf.backend.supervisor.orders import RecordOrder
from rse_pf.backend.supervisor.record_query import may_record, record_query
from rse_pf.control_http import ControlRequest


def asked(*, is_local: bool = True, **query: str) -> ControlRequest:
    return ControlRequest(method="POST", path="/record", query=query, is_local=is_local)


def test_a_server_without_a_control_token_and_another_machine_record_nothing() -> None:
    assert may_record(asked(), "ab" * 16)
    assert not may_record(asked(), None)
    assert not may_record(asked(is_local=False), "ab" * 16)


def test_a_recording_begins_with_its_limits_and_ends_by_its_number() -> None:
    begun = record_query(asked(service="icp", count="5", seconds="2.5", mib="1"))
    over = record_query(asked(recording="7", count="0"))

    assert begun.order(3) == RecordOrder(3, "icp", 5, 1 << 20, 2.5)
    assert (over.order(8).ends, over.order(8).calls) == (7, 0)


@pytest.mark.parametrize(
    "query",
    [
        {}, {"service": "icp"}, {"count": "5"}, {"service": "icp", "count": "10001"},
        {"service": "icp", "count": "-1"}, {"service": "icp", "count": "5", "seconds": "nan"},
        {"service": "icp", "count": "5", "seconds": "3601"}, {"service": "icp", "count": "5", "mib": "65"},
        {"service": "icp", "count": "5", "mib": "0"}, {"service": "icp", "count": "x"},
        {"service": "icp", "count": "5", "recording": "1"},
    ],
    ids=str,
)  # fmt: skip
def test_a_recording_without_limits_is_refused(query: dict[str, str]) -> None:
    with pytest.raises(ValueError):
        record_query(asked(**query))
