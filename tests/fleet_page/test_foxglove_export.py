"""What Foxglove is told of the platform; with its SDK, a viewer gets it over a socket."""

from __future__ import annotations

import json

import numpy as np
import pytest

from rse_pf.errors import MissingExtra
from rse_pf.fleet_page import foxglove_export
from rse_pf.fleet_page.foxglove_export import ExportedMessage, export_messages
from rse_pf.recording.file_format import POSE_SCHEMA, SCHEMAS


def only(topic: str, key: str, value: object) -> ExportedMessage:
    (message,) = export_messages(topic, key, value, now_s=7.0)
    return message


def test_the_fleet_its_events_and_its_commands_are_json_channels() -> None:
    assert only("fleet", "now", {"robots": 3}) == ExportedMessage(
        channel="/fleet", schema="rse_pf.Fleet", value={"robots": 3}
    )
    assert only("event", "", {"kind": "grow"}).channel == "/events"
    assert only("pose", "", {"verdict": "weak"}).channel == "/commands"
    assert only("robots", "now", [{"robot": "a"}]).value == {"rows": [{"robot": "a"}]}


def test_the_pose_of_a_robot_in_a_live_map_is_a_pose_in_the_frame_of_the_map() -> None:
    T = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    value = {"kind": "pose", "robot": "r/1\x1b", "timestamp_s": 1.5, "T_map_camera": T.ravel().tolist()}

    told = only("live/hall", "pose/r", value)

    assert (told.channel, told.schema) == ("/live/hall/r_1_", POSE_SCHEMA)
    assert told.value["timestamp"] == {"sec": 1, "nsec": 500_000_000}
    assert told.value["frame_id"] == "hall"
    assert told.value["pose"]["position"] == {"x": 1.0, "y": 2.0, "z": 3.0}
    assert told.value["pose"]["orientation"] == pytest.approx({"x": 0, "y": 0, "z": 2**-0.5, "w": 2**-0.5})
    assert set(told.value) == set(json.loads(SCHEMAS[POSE_SCHEMA])["properties"])


def test_other_values_of_a_live_map_are_told_as_they_are_and_paths_are_left_out() -> None:
    assert only("live/hall", "map", {"kind": "map", "keyframes": 4}).channel == "/live/hall"
    assert not list(export_messages("live/hall", "path/r", {"points": []}, now_s=0.0))
    assert not list(export_messages("history", "minutes", [[1]], now_s=0.0))
    broken = {"kind": "pose", "robot": "r", "T_map_camera": [1.0]}
    assert only("live/hall", "pose/r", broken).schema == "rse_pf.LiveMap"


def test_without_its_package_the_extra_is_named(tmp_path: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(foxglove_export.sys.modules, "foxglove", None)

    with pytest.raises(MissingExtra) as raised:
        foxglove_export.serve_foxglove(tmp_path, port=0)  # type: ignore[arg-type]
    assert "foxglove" in raised.value.hint
