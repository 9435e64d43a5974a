"""Write the golden messages: exact bytes and their meaning, for every client in any language.

Run it only when the protocol changes on purpose, and say so in CHANGELOG.md.
Promises equal files from equal sources, so that a test can compare them.
"""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from rse_pf.pnp import PnpOptions, solve_pnp
from rse_pf.pnp.problems import make_problem
from rse_pf.services.pnp import PnpReply, make_request
from rse_pf.wire import (
    CODECS,
    SUBPROTOCOLS,
    Cancel,
    Command,
    Failure,
    Hello,
    Limits,
    Message,
    Move,
    Ping,
    Pong,
    Progress,
    Renew,
    Renewed,
    Result,
    Subscribe,
    Unsubscribe,
    Update,
    Welcome,
    make_codec,
)

__all__ = ["MESSAGES", "golden_messages", "golden_poses"]

MESSAGES: dict[str, Message] = {
    "hello": Hello(sdk="rse-pf 0.1.0", capabilities=("pnp",)),
    "hello-shortest": Hello(),
    "welcome": Welcome(
        server="server-1", session="5f0c", robot="robot-7", protocol=1, clock_s=1234.5,
        limits=Limits(max_message_bytes=262144, max_in_flight=8),
    ),
    "welcome-for-a-while": Welcome(
        server="server-1", session="5f0c", robot="robot-7", protocol=1, clock_s=1234.5, token_s=899.5,
        limits=Limits(max_message_bytes=262144, max_in_flight=8),
    ),
    "welcome-with-burst": Welcome(
        server="server-1", session="5f0c", robot="robot-7", protocol=1, clock_s=1234.5, burst_url="/burst",
        limits=Limits(max_message_bytes=262144, max_in_flight=8, burst_commands_per_day=10000),
    ),
    "renew": Renew(token="eyJhbGciOiJFZERTQSJ9.eyJzdWIiOiJyb2JvdC03In0.c2lnbmF0dXJl"),
    "renewed": Renewed(token_s=900.0),
    "command": Command(
        id=7, service="echo", payload={"value": [1, -2.5, "drei", None, True]}, stream="front", seq=41,
        keep=True, deadline_ms=250.0, trace="4bf92f35",
    ),
    "command-shortest": Command(id=0, service="echo"),
    "command-largest-id": Command(id=2**53 - 1, service="echo", payload={"value": "\u00e9\u2603 \"[{\\"}),
    "command-arrays": Command(
        id=8, service="echo",
        payload={
            "value": {
                "float32": np.array([0.5, -1.25, 3.0], dtype=np.float32),
                "uint32": np.array([0, 1, 4294967295], dtype=np.uint32),
                "float64": np.array([0.1, 1e-300, -12345.6789]),
            }
        },
    ),
    "result": Result(
        id=7, reply={"value": 1.5}, server="server-1", queue_ms=0.25, compute_ms=0.5, received_s=1235.0,
        sent_s=1235.001,
    ),
    "failure": Failure(
        id=7, code="busy", message="4 commands of this robot wait", hint="send fewer", retry_after_ms=20.0,
        server="server-1", trace="4bf92f35",
    ),
    "failure-of-a-message": Failure(code="bad-message", message="not a message"),
    "move": Move(reason="drain", within_ms=5000.0),
    "ping": Ping(sent_s=10.25),
    "cancel": Cancel(id=7),
    "progress": Progress(id=7, done=0.25, what="3 of 12 keyframe pairs"),
    "result-as-object": Result(id=7, server="server-1", object="ab" * 32),
    "pong": Pong(sent_s=10.25, received_s=1300.5, answered_s=1300.75),
    "hello-with-updates": Hello(sdk="rse-pf 0.1.0", capabilities=("updates",)),
    "subscribe": Subscribe(id=8, topic="live/warehouse"),
    "unsubscribe": Unsubscribe(id=8),
    "update-of-an-alignment": Update(
        id=8, topic="live/warehouse", seq=3, key="alignment/robot-7",
        payload={
            "kind": "alignment", "robot": "robot-7", "segment": 0, "aligned": True, "reason": "",
            "T_map_odom": np.array([1, 0, 0, 0.5, 0, 1, 0, -2.0, 0, 0, 1, 0.25, 0, 0, 0, 1.0]),
            "covariance": np.arange(1, 22) / 64, "version": 1234,
            "cause": {"robot": "robot-2", "number": 17},
        },
    ),
    "update-of-an-alignment-with-a-scale": Update(
        id=8, topic="live/warehouse", seq=3, key="alignment/robot-7",
        payload={
            "kind": "alignment", "robot": "robot-7", "segment": 2, "aligned": True, "reason": "",
            "T_map_odom": np.array([1, 0, 0, 0.5, 0, 1, 0, -2.0, 0, 0, 1, 0.25, 0, 0, 0, 1.0]),
            "covariance": np.arange(1, 22) / 64, "version": 1236, "cause": None, "scale": 0.52,
        },
    ),
    "update-of-an-unaligned-robot": Update(
        id=8, topic="live/warehouse", seq=4, key="alignment/robot-7",
        payload={
            "kind": "alignment", "robot": "robot-7", "segment": 1, "aligned": False,
            "reason": "no link is believed yet", "T_map_odom": None, "covariance": None, "version": 1240,
            "cause": None,
        },
    ),
    "update-of-a-pose": Update(
        id=8, topic="live/warehouse", seq=5, key="pose/robot-2",
        payload={
            "kind": "pose", "robot": "robot-2", "segment": 0, "timestamp_s": 1311868164.25,
            "T_map_camera": np.array([1, 0, 0, 1.5, 0, 1, 0, 0.0, 0, 0, 1, 3.25, 0, 0, 0, 1.0]),
        },
    ),
    "update-of-a-map": Update(
        id=8, topic="live/warehouse", seq=9, key="map",
        payload={"kind": "map", "keyframes": 231, "version": 1250, "owner": "server-1", "state": "live"},
    ),
    "failure-of-a-subscription": Failure(
        id=8, code="forbidden", message="this token does not hold the scope maps:live/warehouse",
        hint="issue one that does", server="server-1",
    ),
}  # fmt: skip

POSES = {
    "200 points, 30 % wrong": {"seed": 1},
    "300 points, half of them wrong": {"seed": 2, "n": 300, "outlier_ratio": 0.5},
    "12 exact points": {"seed": 3, "n": 12, "outlier_ratio": 0.0, "noise_px": 0.0},
}


def meaning(message: Message) -> Any:
    """Return *message* as plain JSON values, with arrays as lists and defaults left out."""
    return json.loads(make_codec("json").encode(message))


def golden_messages() -> dict[str, Any]:
    """Return name -> sub-protocol -> base64 of the WebSocket message, and the meaning."""
    return {
        name: {
            "meaning": meaning(message),
            "bytes": {
                SUBPROTOCOLS[codec]: base64.b64encode(make_codec(codec).encode(message)).decode()
                for codec in CODECS
            },
        }
        for name, message in MESSAGES.items()
    }


def golden_poses() -> dict[str, Any]:
    """Return name -> pnp command and the reply that an ``ok`` server gives, as JSON values."""
    options = PnpOptions(engine="native")
    found = {}
    for name, arguments in POSES.items():
        problem = make_problem(**arguments)  # type: ignore[arg-type]
        request = make_request(problem.points_world, problem.pixels, problem.camera, options)
        solution = solve_pnp(request.points_world, request.pixels, problem.camera, options)
        command = Command(id=1, service="pnp", payload=request)
        found[name] = {"command": meaning(command), "reply": json.loads(_plain(PnpReply.of(solution)))}
    return found


def _plain(reply: PnpReply) -> bytes:
    return msgspec.json.encode(reply, enc_hook=lambda array: array.tolist())


def write(folder: Path) -> None:
    """Write all golden files into *folder*."""
    messages = json.dumps(golden_messages(), indent=1, ensure_ascii=False)
    (folder / "messages.json").write_text(f"{messages}\n", encoding="utf-8")
    rows = [f"{json.dumps(name)}: {json.dumps(pose)}" for name, pose in golden_poses().items()]
    poses = ",\n".join(rows)
    (folder / "poses.json").write_text(f"{{\n{poses}\n}}\n", encoding="utf-8")


if __name__ == "__main__":
    write(Path(__file__).resolve().parent)
