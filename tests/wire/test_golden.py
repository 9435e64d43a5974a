"""Golden messages: exact bytes that every client, in any language, reads and writes alike."""

from __future__ import annotations

import base64
import importlib.util
import json
import zlib
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import pytest

from rse_pf.config import PlatformSettings
from rse_pf.service import dispatch
from rse_pf.services.builtin import builtin_services
from rse_pf.wire import CODECS, SUBPROTOCOLS, Command, FromRobot, Message, Result, make_codec

GOLDEN = Path(__file__).parent / "golden"
MESSAGES: dict[str, Any] = json.loads((GOLDEN / "messages.json").read_text(encoding="utf-8"))
POSES: dict[str, Any] = json.loads((GOLDEN / "poses.json").read_text(encoding="utf-8"))
POSE_TOLERANCE = 1e-9


def script() -> Any:
    """Return the module that writes the golden files."""
    spec = importlib.util.spec_from_file_location("golden_messages", GOLDEN / "regenerate.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def bytes_of(name: str, codec: str) -> bytes:
    return base64.b64decode(MESSAGES[name]["bytes"][SUBPROTOCOLS[codec]])


def decoded(name: str, codec: str) -> Message:
    wire = make_codec(codec)
    from_robot = MESSAGES[name]["meaning"]["type"] in (
        "hello",
        "command",
        "cancel",
        "ping",
        "renew",
        "subscribe",
        "unsubscribe",
    )
    return (wire.decode_from_robot if from_robot else wire.decode_from_server)(bytes_of(name, codec))


def meaning(message: Message) -> Any:
    """Return *message* as plain JSON values, the defaults left out."""
    return json.loads(msgspec.json.encode(message, enc_hook=_numbers))


def _numbers(array: npt.NDArray[Any]) -> list[float]:
    values: list[float] = array.tolist()
    return values


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("name", MESSAGES)
def test_golden_bytes_mean_what_is_written(name: str, codec: str) -> None:
    assert meaning(decoded(name, codec)) == MESSAGES[name]["meaning"]


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("name", MESSAGES)
def test_a_message_is_written_as_its_golden_bytes(name: str, codec: str) -> None:
    written = make_codec(codec).encode(script().MESSAGES[name])
    golden = bytes_of(name, codec)

    if codec == "zlib":
        written, golden = zlib.decompress(written), zlib.decompress(golden)
    assert written == golden


def test_every_message_of_the_protocol_has_a_golden_one() -> None:
    schemas = msgspec.json.schema(Message)["$defs"]
    tags = {
        schema["properties"]["type"]["enum"][0]
        for schema in schemas.values()
        if "type" in schema["properties"]
    }

    assert {each["meaning"]["type"] for each in MESSAGES.values()} == tags


def test_the_golden_messages_are_those_that_the_script_writes() -> None:
    made = script().golden_messages()

    assert made.keys() == MESSAGES.keys()
    for name, golden in made.items():
        assert golden["meaning"] == MESSAGES[name]["meaning"]
        assert golden["bytes"].keys() == MESSAGES[name]["bytes"].keys()


def assert_same_reply(made: Any, golden: Any) -> None:
    for exact in ("inliers", "verdict", "reason", "engine"):
        assert made[exact] == golden[exact], exact
    np.testing.assert_allclose(made["T_camera_world"], golden["T_camera_world"], rtol=0, atol=POSE_TOLERANCE)
    np.testing.assert_allclose(made["rmse_px"], golden["rmse_px"], rtol=1e-6)
    np.testing.assert_allclose(made["covariance"], golden["covariance"], rtol=1e-3, atol=1e-12)


@pytest.mark.parametrize("name", POSES)
def test_a_golden_pnp_command_gets_its_golden_pose(name: str) -> None:
    wire = make_codec("json")
    command = wire.decode_from_robot(json.dumps(POSES[name]["command"]).encode())
    assert isinstance(command, Command)

    answer = dispatch(builtin_services(PlatformSettings()), command, lambda: 0.0)

    assert isinstance(answer, Result), answer
    assert_same_reply(meaning(answer)["reply"], POSES[name]["reply"])


def test_the_golden_poses_are_those_that_the_script_writes() -> None:
    made = script().golden_poses()

    assert made.keys() == POSES.keys()
    for name, golden in made.items():
        assert golden["command"] == POSES[name]["command"]
        assert_same_reply(golden["reply"], POSES[name]["reply"])


def test_a_robot_message_is_no_server_message() -> None:
    assert not isinstance(decoded("welcome", "json"), FromRobot)
