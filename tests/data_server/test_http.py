"""Ranges, failures and numbers in headers, apart from any route."""

from __future__ import annotations

import json

import pytest

from rse_pf.data_server.http import MethodNotAllowed, failure_reply
from rse_pf.errors import Busy, InternalError, RsePfError, StoreFull, Unauthorized


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
