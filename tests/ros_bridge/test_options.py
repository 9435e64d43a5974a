"""Tests of `ros_bridge.options` and of the command line of the bridge."""

from __future__ import annotations

import pytest

from ros_bridge import BridgeOptions
from ros_bridge.__main__ import main


def test_topics_and_frames_of_a_robot_have_its_namespace() -> None:
    options = BridgeOptions(namespace="/fleet/robot1/")
    assert options.named("rse_pf/pose") == "/fleet/robot1/rse_pf/pose"
    assert options.named("/tf") == "/tf"
    assert options.own_odom_frame == "fleet/robot1/odom"
    assert options.own_base_frame == "fleet/robot1/base_link"
    assert BridgeOptions(namespace="robot1", base_frame="/base_link").own_base_frame == "base_link"
    assert BridgeOptions(namespace="robot1", base_frame="").own_base_frame == ""
    assert BridgeOptions().named("rse_pf/pose") == "/rse_pf/pose"


@pytest.mark.parametrize(
    "words",
    [["ros2"], ["ros1", "--queue-frames", "many"]],
    ids=lambda words: words[0],
)
def test_what_cannot_start_is_said_in_one_line(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) != 0
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 2
    assert "Traceback" not in said
    assert "hint" in said


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (["ros2", "--colourr", "x"], "--colourr"),
        (["ros2", "--colour"], "--colour"),
        (["ros3"], "ros3"),
        ([], "shell"),
    ],
)
def test_a_wrong_command_line_is_one_line_with_a_hint(
    words: list[str], what: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)

    said = capsys.readouterr().err.splitlines()
    assert ended.value.code == 2
    assert len(said) == 2
    assert what in said[0]
    assert said[1] == "  hint: see rse-pf-ros --help"
