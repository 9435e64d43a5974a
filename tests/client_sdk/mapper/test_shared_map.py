"""A mapper's map for others: its keyframes and cloud, shared under a name, and merged with other maps."""

from __future__ import annotations

import asyncio
from typing import Any

import msgspec
import numpy as np
import pytest

import client_sdk
from client_sdk.commands.answer_types import Answer
from client_sdk.mapper import Mapper
from rse_pf.maps.format import decode_map
from rse_pf.services.mapping.merge import MergeReply
from tests.client_sdk.mapper.test_mapper import drive
from tests.kit.fake_live_map import solve

pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")


def test_the_keyframes_of_a_drive_are_in_its_encoded_map() -> None:
    mapper = Mapper(ask=solve, keyframes_of="robot-1")
    drive(mapper, range(0, 12, 2), depth=True)

    version = decode_map(mapper.encoded_map())

    assert len(version.keyframes) == mapper.keyframes >= 2
    assert [each.id for each in version.keyframes] == list(range(mapper.keyframes))
    assert {each.robot for each in version.keyframes} == {"robot-1"}
    first, last = version.keyframes[0], version.keyframes[-1]
    np.testing.assert_allclose(first.T_world_camera, np.eye(4), atol=1e-9)
    row = mapper.trajectory.timestamps_s.tolist().index(last.timestamp_s)
    np.testing.assert_allclose(last.T_world_camera, mapper.trajectory.T_world_camera[row])
    assert np.isfinite(last.points_camera).all(axis=1).sum() > 100
    assert len(last.points_camera) == len(last.pixels) == len(last.descriptors)
    assert len(version.points) > 1000


REPLY = MergeReply(
    map=b"merged",
    joined=[0, 1],
    not_joined=[],
    refused=[],
    loops=0,
    merges=3,
    cost_before=2.0,
    cost_after=1.0,
)


class FakeParties:
    """A data client and a robot in one: it names objects by their length, and merges at once."""

    def __init__(self, *, stores_reply: bool) -> None:
        self.asked: Any = None
        self._stores_reply = stores_reply

    def upload(self, data: bytes) -> str:
        return f"digest-{len(data)}"

    def download(self, digest: str) -> bytes:
        assert digest == "digest-of-reply"
        return msgspec.msgpack.encode(REPLY)

    async def call(self, service: str, request: Any, reply_type: Any, *, on_progress: Any) -> Answer:
        assert (service, reply_type, callable(on_progress)) == ("merge", MergeReply, True)
        self.asked = request
        return Answer(
            source="cloud", server="s", round_trip_ms=1.0, queue_ms=0.0, compute_ms=0.0,
            reply=None if self._stores_reply else REPLY, object="digest-of-reply",
        )  # fmt: skip


@pytest.mark.parametrize("stores_reply", [True, False])
def test_maps_are_merged_by_their_digests_and_a_stored_reply_is_fetched(stores_reply: bool) -> None:
    parties: Any = FakeParties(stores_reply=stores_reply)

    reply = asyncio.run(client_sdk.merge_maps(parties, parties, [b"one", b"three"]))

    assert reply == REPLY
    assert parties.asked == {"maps": [{"object": "digest-3"}, {"object": "digest-5"}]}
