"""Tests of `ros_bridge.options` and of the command line of the bridge."""

from __future__ import annotations

import pytest

from ros_bridge import BridgeOptions
from ros_bridge.__main__ import main
from rse_pf.errors import UsageError


def test_parameters_come_as_words_and_numbers() -> None:
    options = BridgeOptions.of({"depth_scale": "5000", "publish_odom": "false", "queue_frames": 3})
    assert (options.depth_scale, options.publish_odom, options.queue_frames) == (5000.0, False, 3)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"color": "/a"}, "unknown parameter 'color'"),
        ({"depth_scale": "much"}, "depth_scale = 'much' is no float"),
        ({"publish_odom": "perhaps"}, "publish_odom = 'perhaps' is no bool"),
        ({"pair_within_s": 0}, "pair_within_s = 0 is not above 0"),
        ({"queue_frames": 0}, "queue_frames = 0"),
        ({"namespace": "a b"}, "is no name of ROS"),
        ({"colour": ""}, "a topic of colours"),
        ({"map": "hall", "depth": ""}, "a live map needs a topic of depth"),
    ],
)
def test_a_wrong_parameter_is_one_line(values: dict[str, object], said: str) -> None:
    with pytest.raises(UsageError, match=said.replace("(", r"\(")):
        BridgeOptions.of(values)


def test_topics_and_frames_of_a_robot_have_its_namespace() -> None:
    options = BridgeOptions(namespace="/fleet/robot1/")
    assert options.named("rse_pf/pose") == "/fleet/robot1/rse_pf/pose"
    assert options.named("/tf") == "/tf"
    assert options.own_odom_frame == "fleet/robot1/odom"
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


def test_the_folder_of_the_packages_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["where"]) == 0
    assert capsys.readouterr().out.strip().endswith("ros_bridge/packages")
