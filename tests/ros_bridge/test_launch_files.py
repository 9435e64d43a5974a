"""The launch files name parameters that exist, and have defaults that roslaunch takes."""

from __future__ import annotations

import re
from pathlib import Path

import ros_bridge
from ros_bridge.ros1_node import CALL_REPLY, CALL_REQUEST

PACKAGE = Path(ros_bridge.__file__).parent / "packages" / "rse_pf_bridge"


def test_the_service_is_defined_as_the_node_offers_it() -> None:
    text = (PACKAGE / "srv" / "Call.srv").read_text(encoding="utf-8")
    request, reply = (
        "\n".join(line for line in part.splitlines() if line and not line.startswith("#"))
        for part in re.split(r"^---$", text, flags=re.MULTILINE)
    )
    assert (request, reply) == (CALL_REQUEST, CALL_REPLY)
