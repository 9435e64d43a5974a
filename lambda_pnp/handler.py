"""Answer one command of a robot by HTTP: the entry point of the AWS Lambda function.

The request's body is the message that a robot would send by WebSocket; the token is in ``Authorization:
Bearer``, the sub-protocol in Content-Type.  Failures are those of a backend server.  Settings and keys are
kept between calls, and nothing else.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from lambda_pnp.answering import Answering, LambdaAnswer, load_answering

__all__ = ["handler"]

_IMPORTED_S = time.monotonic()  # the time of a cold start is counted from here
_ANSWERING: list[Answering] = []  # empty before the first call in this execution environment, then one


def handler(event: Mapping[str, Any], context: Any) -> dict[str, Any]:
    """Return the response to one event of a load balancer or a Function URL.

    The first call of an execution environment (a cold start) loads the settings.
    """
    cold = not _ANSWERING
    if cold:
        _ANSWERING.append(load_answering())
    init_ms = (time.monotonic() - _IMPORTED_S) * 1e3 if cold else 0.0
    left_ms = float(context.get_remaining_time_in_millis())
    answer: LambdaAnswer = _ANSWERING[0].answer(
        event, now_s=time.time(), left_ms=left_ms, clock=time.monotonic
    )
    return answer.as_http(event, init_ms=init_ms, cold=cold)
