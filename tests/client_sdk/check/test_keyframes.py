"""Tests of the keyframes of a drive: which frames are kept, and what of them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from client_sdk.check.keyframes import KeyframeStore, depths_at
from client_sdk.frontend import Features, Frame, TrackedFrame
from client_sdk.simulator import render_frames
from client_sdk.tracking.monocular_tracker import MonocularTracker
from client_sdk.tracking.tracker import Tracker
from rse_pf.maps.descriptors import DescriptorKind


@cache
def frames() -> tuple[Frame, ...]:
    return tuple(render_frames(0, 1, 9, 3))


def found_by(frame: Frame, tracker: Tracker | MonocularTracker) -> Features:
    tracked = tracker.prepare(frame)
    assert isinstance(tracked, TrackedFrame)
    assert tracked.features is not None
    return tracked.features


def test_depths_around_a_keyframe_are_those_of_other_frames_at_its_pixels() -> None:
    seen, store = frames(), KeyframeStore()

    for frame in seen:
        store.add(frame, None)

    middle = next(keyframe for keyframe in store.keyframes if 2 <= keyframe.row <= 6)
    offsets = sorted(round(each[0], 3) for each in middle.around)
    assert offsets == [-0.4, -0.2, 0.0, 0.2, 0.4]
    later = {round(offset, 3): depths for offset, depths in middle.around}[0.2]
    np.testing.assert_array_equal(later, depths_at(seen[middle.row + 1].depth_m, middle.pixels))


def test_vectors_of_a_user_are_not_compared_as_orb_is() -> None:
    frame, store = frames()[0], KeyframeStore()
    found = replace(found_by(frame, Tracker()), kind=DescriptorKind("lines", "int8", 16))

    store.add(frame, None, found)

    assert store.keyframes[0].descriptors.shape == (len(store.keyframes[0].pixels), 32)
    assert len(store.keyframes[0].pixels) <= 500
