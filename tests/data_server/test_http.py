"""Ranges, failures and numbers in headers, apart from any route."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rse_pf.data_server.http import MethodNotAllowed, failure_reply, requested_range
from rse_pf.errors import BadRequest, Busy, InternalError, RsePfError, StoreFull, Unauthorized


@given(start=st.integers(0, 50), end=st.integers(0, 50), size=st.integers(1, 40))
def test_a_range_of_two_numbers_is_the_slice_that_it_names(start: int, end: int, size: int) -> None:
    data = bytes(range(size))
    text = f"bytes={start}-{end}"

    if start > end:
        assert requested_range(text, size) is None
    elif start >= size:
        with pytest.raises(BadRequest):
            requested_range(text, size)
    else:
        found = requested_range(text, size)
        assert found is not None
        assert data[slice(*found)] == data[start : end + 1]


@pytest.mark.parametrize(
    ("error", "status", "header"),
    [
        (Unauthorized("x"), 401, ("WWW-Authenticate", "Bearer")),
        (Busy("x", retry_after_ms=2400.0), 503, ("Retry-After", "3")),
        (Busy("x", retry_after_ms=1.0), 503, ("Retry-After", "1")),
        (MethodNotAllowed("GET, PUT"), 405, ("Allow", "GET, PUT")),
        (StoreFull("x"), 507, None),
        (InternalError("x"), 500, None),
    ],
)
def test_an_error_becomes_its_status_its_code_and_its_header(
    error: RsePfError, status: int, header: tuple[str, str] | None
) -> None:
    reply = failure_reply(error)

    assert reply.status == status
    assert isinstance(reply.body, bytes)
    assert json.loads(reply.body)["code"] == error.code
    assert dict(reply.headers) == ({} if header is None else dict([header]))
