"""Answer one command by HTTP, with the bytes of the WebSocket: token, decode, dispatch, encode.

The token is sent as ``Authorization: Bearer``, the sub-protocol as Content-Type.  Failures are the same as
those of a backend server.  Only settings and keys are kept between calls.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from lambda_pnp.answering import Answering, LambdaAnswer, load_answering

__all__ = ["handler"]

_IMPORTED_S = time.monotonic()
_ANSWERING: list[Answering] = []


def handler(event: Mapping[str, Any], context: Any) -> dict[str, Any]:
    """Answer one event of a load balancer, or of a Function URL."""
    cold = not _ANSWERING
    if cold:
        _ANSWERING.append(load_answering())
    init_ms = (time.monotonic() - _IMPORTED_S) * 1e3 if cold else 0.0
    left_ms = float(context.get_remaining_time_in_millis())
    answer: LambdaAnswer = _ANSWERING[0].answer(
        event, now_s=time.time(), left_ms=left_ms, clock=time.monotonic
    )
    return answer.as_http(event, init_ms=init_ms, cold=cold)
