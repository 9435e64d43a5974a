"""Logs, snapshots and spools of protocol version 1 are read, with the same numbers.

``version_1.msgpack.zlib`` was written by the release before: two robots that met, 18 keyframes, one of which
had lost its features, with what that release decoded.
"""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from client_sdk.live.waiting_keyframes import WaitingKeyframes
from rse_pf.errors import BadRequest, UsageError
from rse_pf.live_map.events import MapStarted, decode_events, encode_events
from rse_pf.live_map.graph import Graph
from rse_pf.live_map.live_map import LiveMap
from rse_pf.slam.keyframe import Keyframe, decode_keyframe

OLD: dict[str, Any] = msgspec.msgpack.decode(
    zlib.decompress(Path(__file__).with_name("version_1.msgpack.zlib").read_bytes())
)

SAME_M = 1e-12
"""Poses are computed anew from a log, by arithmetic that rounds differently; they differ by 2e-16 at most."""


def assert_as_before(live_map: LiveMap) -> None:
    """Compare a map with what the release before decoded: poses, links, cameras, times and features."""
    graph = live_map._graph
    np.testing.assert_allclose(graph.T.ravel(), np.frombuffer(OLD["T"]), rtol=0, atol=SAME_M)
    assert graph.T_odom.tobytes() == OLD["T_odom"]
    assert live_map.links_believed == OLD["believed"]
    assert [row.timestamp_s for row in graph.keyframes] == OLD["timestamps_s"]
    for row, before in zip(graph.keyframes, OLD["features"], strict=True):
        assert (row.data is None) == (before is None)
        if row.data is not None:
            assert_features(decode_keyframe(row.data), before)


def assert_features(keyframe: Keyframe, before: list[bytes]) -> None:
    features = keyframe.features
    assert [features.pixels.tobytes(), features.depths_m.tobytes(), features.descriptors.tobytes()] == before
    camera = keyframe.camera
    assert [camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height] == OLD["cameras"][0]


def replayed() -> LiveMap:
    live_map = LiveMap()
    for entry in OLD["entries"]:
        for event in decode_events(entry):
            live_map.apply(event)
    return live_map


def test_a_log_of_version_1_gives_the_same_map() -> None:
    assert_as_before(replayed())


def test_a_snapshot_of_version_1_gives_the_same_map_and_is_written_in_todays_form() -> None:
    restored = LiveMap.restore_parts(OLD["head"], lambda name: OLD["parts"][name])
    written = restored.snapshot_parts(known=OLD["parts"])
    again = LiveMap.restore_parts(written.head, lambda name: written.parts[name] or b"")

    assert_as_before(restored)
    np.testing.assert_allclose(restored._graph.T, replayed()._graph.T, rtol=0, atol=SAME_M)
    assert again.digest() == restored.digest()
    assert not again._graph.cameras_v1


def test_a_start_of_version_1_begins_the_same_map() -> None:
    [event] = decode_events(OLD["started"])
    assert isinstance(event, MapStarted)
    live_map = LiveMap()
    live_map.apply(event)

    assert live_map.keyframes == 17
    assert decode_events(encode_events([event])) == [event]
    kept = [features for features in OLD["features"] if features is not None]
    for start, before in zip(event.keyframes, kept, strict=True):
        assert_features(decode_keyframe(start.data), before)


def test_a_snapshot_of_a_later_version_is_refused_with_how_to_publish_first() -> None:
    packed = msgspec.msgpack.decode(replayed()._graph.encode({}))
    packed["version"] = 3

    with pytest.raises(BadRequest, match="the snapshot is of version 3, not 2") as refused:
        Graph.decode(msgspec.msgpack.encode(packed))

    assert "rse-pf map publish MAP" in refused.value.hint


def test_keyframes_that_waited_in_version_1_are_sent_in_todays_form(tmp_path: Path) -> None:
    (tmp_path / f"{4:012d}.keyframe").write_bytes(OLD["waiting"])
    waiting = WaitingKeyframes(tmp_path)

    assert waiting.open() == 2
    first = waiting.first()
    assert (first.index, first.segment, waiting.next_index) == (4, 1, 5)
    keyframe = decode_keyframe(first.data)
    assert keyframe.timestamp_s == OLD["timestamps_s"][0] + 1.25
    assert_features(keyframe, OLD["features"][0])
    assert [path.name for path in tmp_path.glob("*.keyframe")] == ["000000000004-1.keyframe"]
    waiting.close()


def test_a_damaged_keyframe_of_version_1_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / f"{4:012d}.keyframe").write_bytes(OLD["waiting"][:-5])

    with pytest.raises(UsageError, match="cannot use the keyframes in") as refused:
        WaitingKeyframes(tmp_path).open()

    assert refused.value.hint == "name another folder as spool"
