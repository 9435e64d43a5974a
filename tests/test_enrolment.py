"""The one file of a robot: what is in it, who may read it, and the tokens that it signs."""

from __future__ import annotations

import json
import stat
import time
from pathlib import Path

import pytest

from rse_pf.auth.roster import DenyList, EnrolledRobot, Roster
from rse_pf.auth.tokens import KeySet, SigningKey, verify_token
from rse_pf.config import AuthSettings
from rse_pf.enrolment import Enrolment, EnrolmentFile
from rse_pf.errors import UsageError

KEY = json.loads(SigningKey.of_robot(b"r" * 32).to_json())
MADE = Enrolment(url="wss://10.1.2.3:8700/ws", authority="PEM", robot="robot-1", tenant="lab", key=KEY)


def test_the_file_is_private_json_that_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "robot-1.enrolment"

    MADE.write(path)

    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    told = json.loads(path.read_text())
    assert (told["format"], told["version"], told["url"]) == ("rse-pf-enrolment", 1, MADE.url)
    assert Enrolment.read(path) == MADE


def test_its_tokens_are_those_of_the_enrolled_robot(tmp_path: Path) -> None:
    path = tmp_path / "robot-1.enrolment"
    MADE.write(path)
    robot = EnrolledRobot(robot="robot-1", tenant="lab", x=KEY["x"])
    keys = KeySet({}).with_access_control(Roster(robots=(robot,)), DenyList())
    now = time.time()

    token = EnrolmentFile(path, clock=lambda: now).fresh_token()

    claims = verify_token(token, keys=keys, now=now, settings=AuthSettings())
    assert (claims.robot.tenant, claims.robot.name) == ("lab", "robot-1")


def test_an_existing_file_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "robot-1.enrolment"
    path.write_text("mine")

    with pytest.raises(UsageError, match="exists already"):
        MADE.write(path)
    assert path.read_text() == "mine"


@pytest.mark.parametrize(
    ("content", "mode", "said"),
    [
        ("{}", 0o600, "is not an enrolment"),
        ("nonsense", 0o600, "is not an enrolment"),
        (
            '{"format": "rse-pf-enrolment", "version": 2, "url": "", "robot": "a", "key": {}}',
            0o600,
            "is not an",
        ),
        ("{}", 0o644, "others may read"),
    ],
)
def test_a_wrong_file_is_one_clear_line(tmp_path: Path, content: str, mode: int, said: str) -> None:
    path = tmp_path / "robot-1.enrolment"
    path.write_text(content)
    path.chmod(mode)

    with pytest.raises(UsageError, match=said) as caught:
        Enrolment.read(path)
    assert "\n" not in caught.value.message
    assert caught.value.hint
