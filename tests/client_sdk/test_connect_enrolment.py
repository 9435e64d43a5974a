"""connect(enrolment=FILE): address and key come from the file, which is read when the robot connects."""

from __future__ import annotations

import asyncio
import json
import ssl
from pathlib import Path

import pytest

import client_sdk
from client_sdk.network.dial_errors import untrusted_certificate_error
from rse_pf.auth.tokens import SigningKey
from rse_pf.enrolment import Enrolment
from rse_pf.errors import ConnectError, UsageError
from tests.kit.fake_platform import FakePlatform

KEY = json.loads(SigningKey.of_robot(b"r" * 32).to_json())


@pytest.mark.system
async def test_a_robot_connects_by_the_address_of_its_file(tmp_path: Path) -> None:
    file = tmp_path / "robot-1.enrolment"

    async with FakePlatform() as platform:
        robot = client_sdk.connect(enrolment=file)
        Enrolment(url=platform.url, robot="robot-1", key=KEY).write(file)
        async with robot:
            assert (await robot.call("echo", {"value": 7})).reply["value"] == 7


@pytest.mark.parametrize(
    "how",
    [{}, {"url": "ws://a/ws", "enrolment": "r"}, {"token": "t", "enrolment": "r"}],
)
def test_an_address_and_an_enrolment_exclude_each_other(how: dict) -> None:
    with pytest.raises(UsageError, match="either an address or an enrolment"):
        client_sdk.connect(**how)


def test_a_missing_file_is_one_clear_line_when_the_robot_connects(tmp_path: Path) -> None:
    async def run() -> None:
        async with client_sdk.connect(enrolment=tmp_path / "none"):
            pass

    with pytest.raises(UsageError, match="cannot read the enrolment"):
        asyncio.run(run())


@pytest.mark.parametrize(
    ("code", "message", "hint"),
    [
        (20, "unable to get local issuer certificate", "rse-pf robot enrol"),
        (10, "certificate has expired", "clock of this robot"),
        (9, "certificate is not yet valid", "clock of this robot"),
    ],
)
def test_a_certificate_that_is_not_trusted_is_not_tried_again_at_once(
    code: int, message: str, hint: str
) -> None:
    cause = ssl.SSLCertVerificationError()
    cause.verify_code, cause.verify_message = code, message

    failed = untrusted_certificate_error("wss://10.1.2.3:8700/ws", cause)

    assert isinstance(failed.error, ConnectError)
    assert message in failed.error.message
    assert hint in failed.error.hint
    assert (failed.is_wrong_address, failed.is_refusal) == (True, False)
