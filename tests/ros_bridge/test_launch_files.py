"""The launch files name parameters that exist, and have defaults that roslaunch takes."""

from __future__ import annotations

import ast
import re
import xml.etree.ElementTree as ET
from dataclasses import fields
from pathlib import Path

import ros_bridge
from ros_bridge import BridgeOptions
from ros_bridge.ros1_node import CALL_REPLY, CALL_REQUEST

PACKAGE = Path(ros_bridge.__file__).parent / "packages" / "rse_pf_bridge"
OPTIONS = {each.name: each.default for each in fields(BridgeOptions)}


def test_the_launch_file_of_ros1_sets_parameters_of_the_bridge() -> None:
    launch = ET.parse(PACKAGE / "launch" / "bridge.launch").getroot()
    arguments = {each.attrib["name"]: each.attrib["default"] for each in launch.findall("arg")}
    node = launch.find("node")
    assert node is not None

    params = {each.attrib["name"]: each.attrib["value"] for each in node.findall("param")}
    assert set(params) <= set(OPTIONS)
    assert set(params.values()) == {f"$(arg {name})" for name in params}
    same = {name: value for name, value in arguments.items() if name in ("colour", "depth", "info")}
    assert same == {name: OPTIONS[name] for name in same}
    numbers = {name: float(arguments[name]) for name in ("queue_frames", "pair_within_s")}
    assert numbers == {name: OPTIONS[name] for name in numbers}
    assert arguments["namespace"] == "/"  # roslaunch refuses an empty one
    assert node.attrib["ns"] == "$(arg namespace)"


def test_the_launch_file_of_ros2_names_options_of_the_bridge() -> None:
    tree = ast.parse((PACKAGE / "launch" / "bridge_launch.py").read_text(encoding="utf-8"))
    (table,) = (
        each.value
        for each in tree.body
        if isinstance(each, ast.Assign) and ast.unparse(each.targets[0]) == "ARGUMENTS"
    )
    arguments = ast.literal_eval(table)
    BridgeOptions.of(arguments)
    assert {name: arguments[name] for name in ("colour", "depth", "info")} == {
        name: OPTIONS[name] for name in ("colour", "depth", "info")
    }


def test_the_service_is_defined_as_the_node_offers_it() -> None:
    text = (PACKAGE / "srv" / "Call.srv").read_text(encoding="utf-8")
    request, reply = (
        "\n".join(line for line in part.splitlines() if line and not line.startswith("#"))
        for part in re.split(r"^---$", text, flags=re.MULTILINE)
    )
    assert (request, reply) == (CALL_REQUEST, CALL_REPLY)
