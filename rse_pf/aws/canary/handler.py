"""The canary: request one known pose through the load balancer, as a robot does, and fail if it is wrong.

A schedule calls the function each minute.  The canary is an enrolled robot with the scope services:pnp; its
private key is in a secret that only this function may read, so that it can sign tokens for no other robot.
Each failed execution counts in the function's metric Errors, which the alarm ``canary`` reads, and one log
line says what failed.
"""

from __future__ import annotations

import json
import os
import secrets
import socket
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from rse_pf.auth.tokens import SigningKey
from rse_pf.aws.clients import call_api, make_client
from rse_pf.config import PlatformSettings, load_settings
from rse_pf.errors import ConnectError, Expired, InternalError, RsePfError
from rse_pf.pnp.problems import make_problem
from rse_pf.services import pnp
from rse_pf.terminal import show
from rse_pf.wire import SUBPROTOCOLS, make_codec
from rse_pf.wire.client_session import Answered, ClientSession, ConnectionLost, Notice, Welcomed
from rse_pf.wire.codec import as_type
from rse_pf.wire.messages import Failure

__all__ = ["ask_known_pose", "handler", "read_key"]

_ROOT = Path(__file__).resolve().parents[3]
_CODEC = "zlib"  # the codec that robots use by default
# Seconds from the begin of the connection until the answer must have arrived.
_TIMEOUT_S = 10.0
# Time limit of the closing handshake in seconds: short, because the answer has been received before.
_CLOSE_TIMEOUT_S = 1.0
_HINT = "check the load balancer's target groups, and read the servers' journals"
# Seed of the PnP problem: the same in every call, so that the answers can be compared.
_SEED = 20260101
# Largest allowed difference of an element of the 4x4 pose from the true one; a right solver is within 0.001.
_MAX_POSE_ERROR = 0.02
_KEYS: dict[str, SigningKey] = {}
"""The canary's private key by the ARN of its secret, kept between calls until a call fails."""


def handler(event: Mapping[str, Any], context: Any) -> dict[str, Any]:
    """Request the known pose once, and return server, round-trip time (ms) and error of the pose.

    Raises RsePfError if no right pose came in time, so that Lambda counts an error of the function.
    """
    settings, trace = load_settings(_ROOT / "settings.json"), secrets.token_hex(16)
    try:
        outcome = _ask(os.environ, settings, trace)
    except RsePfError as error:
        _KEYS.clear()  # the operator may have replaced the key, so the next call reads it again
        _log(event="canary-failed", trace=trace, code=error.code, error=error.message[:200])
        raise
    _log(event="canary-solved", trace=trace, **outcome)
    return outcome


def read_key(secret: str, region: str) -> SigningKey:
    """Return the private key of the canary's robot, which the secret *secret* holds; raises RsePfError."""
    secret_value = call_api(make_client("secretsmanager", region), "get_secret_value", SecretId=secret)
    return SigningKey.from_json(str(secret_value["SecretString"]))


def ask_known_pose(
    url: str, token: str, settings: PlatformSettings, *, trace: str, clock: Callable[[], float]
) -> dict[str, Any]:
    """Request the pose of one seeded PnP problem from the platform at *url*, and check the answer.

    Returns ``server`` (the id of the server), ``took_ms`` (from the begin of the connection to the answer)
    and ``error`` (the largest difference of an element of the pose from the true one).

    Args:
        url: Address of the load balancer, such as ``wss://robots.example.org/ws``.
        token: Token of the canary's robot.
        settings: Limits of the session.
        trace: Trace id, which the server logs with the command.
        clock: Monotonic seconds.

    Raises:
        RsePfError: No server answers, the server refuses, the answer is late, or the pose is wrong.
    """
    problem = make_problem(seed=_SEED, noise_px=0.5, outlier_ratio=0.3)
    codec = make_codec(_CODEC, settings.session)
    session = ClientSession(codec=codec, settings=settings.session, sdk="rse-pf-canary")
    began = clock()
    request = pnp.make_request(problem.points_world, problem.pixels, problem.camera)
    session.submit("pnp", request, now=began, deadline_s=_TIMEOUT_S, trace=trace)
    address = urlsplit(url)
    host, port = address.hostname or "", address.port or (443 if address.scheme == "wss" else 80)
    try:
        # With a socket from its caller the library follows no redirects; robots follow none either.
        stream = socket.create_connection((host, port), timeout=_TIMEOUT_S)
        with connect(
            url, sock=stream, subprotocols=[Subprotocol(SUBPROTOCOLS[_CODEC])], compression=None,
            additional_headers={"Authorization": f"Bearer {token}"}, open_timeout=_TIMEOUT_S,
            ping_interval=None, close_timeout=_CLOSE_TIMEOUT_S, max_size=settings.session.max_message_bytes,
        ) as websocket:  # fmt: skip
            answered = _exchange(session, websocket, clock, until_s=began + _TIMEOUT_S)
    except InvalidStatus as error:
        body = error.response.body[:200].decode("utf-8", "replace")
        raise ConnectError(f"the handshake failed: {error}: {body}", hint=_HINT) from error
    except ConnectionClosed as error:
        raise ConnectError(f"the server left: {error}", hint=_HINT) from error
    except (OSError, ValueError, WebSocketException) as error:
        raise ConnectError(f"no server answers at {host}:{port}: {error}", hint=_HINT) from error
    return _check_answer(answered, problem.T_camera_world, (clock() - began) * 1e3)


def _exchange(
    session: ClientSession, websocket: ClientConnection, clock: Callable[[], float], until_s: float
) -> Answered:
    """Exchange messages over *websocket* until the session's command is answered; return the answer.

    Raises:
        Expired: There was no answer before *until_s* on *clock*.
        InternalError: The session failed, or the server sent a notice.
    """
    connection = session.open_connection(clock())
    while True:
        while connection.outgoing:
            websocket.send(connection.outgoing.pop(0))
        try:
            message = websocket.recv(until_s - clock(), decode=False)
        except TimeoutError as error:
            raise Expired(f"no answer within {_TIMEOUT_S:g} s", hint="read the servers' journals") from error
        for event in session.receive(connection, message, clock()):
            if isinstance(event, Welcomed):
                session.adopt(connection, clock())
            elif isinstance(event, Answered):
                return event
            elif isinstance(event, ConnectionLost | Notice):
                raise InternalError(f"the session failed: {event}", hint="read the server's journal")


def _check_answer(event: Answered, expected: Any, took_ms: float) -> dict[str, Any]:
    answer = event.answer
    if isinstance(answer, Failure):
        raise InternalError(f"{answer.server} answered {answer.code}: {answer.message}", hint=answer.hint)
    pose = as_type(answer.reply, pnp.PnpReply).solution().T_camera_world
    error = float(np.abs(pose - expected).max())
    if not error < _MAX_POSE_ERROR:
        raise InternalError(
            f"the pose of {answer.server} is wrong by {error:.3g}, more than {_MAX_POSE_ERROR:g}",
            hint="compare the release of the servers with the last good one",
        )
    return {"server": answer.server, "took_ms": round(took_ms, 1), "error": round(error, 6)}


def _ask(environment: Mapping[str, str], settings: PlatformSettings, trace: str) -> dict[str, Any]:
    secret, robot = environment["RSE_PF_CANARY_SECRET"], environment["RSE_PF_CANARY_ROBOT"]
    if secret not in _KEYS:
        _KEYS[secret] = read_key(secret, settings.cloud.region)
    token = _KEYS[secret].issue(
        robot, now=time.time(), token_id=secrets.token_hex(12), settings=settings.auth
    )  # fmt: skip
    return ask_known_pose(
        environment["RSE_PF_CANARY_URL"], token, settings, trace=trace, clock=time.monotonic
    )


def _log(**fields: Any) -> None:
    show(json.dumps(fields), error=True)
