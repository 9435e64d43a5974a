"""Descriptors of any kind: how they are matched, and that two kinds are never compared."""

from __future__ import annotations

import re
import struct
import time
import zlib
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import pytest

from rse_pf.config import PlatformSettings
from rse_pf.errors import BadRequest, LimitExceeded
from rse_pf.geometry import Camera, exp_se3
from rse_pf.live_map.events import KeyframeAdded, RobotForgotten
from rse_pf.live_map.live_map import LiveMap
from rse_pf.live_map.versions import started_from
from rse_pf.maps.descriptors import ORB, DescriptorKind, common_kind
from rse_pf.maps.format import Keyframe, MapVersion, decode_map, encode_map
from rse_pf.service import dispatch
from rse_pf.services.builtin import builtin_services
from rse_pf.slam.descriptors import (
    best_matches,
    distance_bound,
    distance_matrix,
    distances_of_pairs,
    measure_distinctiveness,
)
from rse_pf.slam.keyframe import (
    MAX_KEYFRAME_BYTES,
    SentKeyframe,
    decode_keyframe,
    encode_keyframe,
    make_features,
    max_features,
)
from rse_pf.slam.loop_closures import Atlas
from rse_pf.slam.place_recognition import place_vector
from rse_pf.slam.tracking import (
    Features,
    GuidedMatchLimits,
    PredictedFeatures,
    match_predictions,
)
from rse_pf.wire import Command, Failure, Result

CAMERA = Camera(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480)
SIFT, XFEAT, AKAZE = (
    DescriptorKind("sift", "int8", 128),
    DescriptorKind("xfeat", "int8", 64),
    DescriptorKind("akaze", "uint8", 61),
)
KINDS = (ORB, SIFT, XFEAT, AKAZE)
HEAD, BLOCK = 108, 8
FEATURES_AT = HEAD + BLOCK + 38 + BLOCK


def random_descriptors(kind: DescriptorKind, n: int, seed: int = 1) -> npt.NDArray[Any]:
    low, high = (0, 256) if kind.dtype == "uint8" else (-128, 128)
    return np.random.default_rng(seed).integers(low, high, (n, kind.size)).astype(kind.dtype)


def keyframe(kind: DescriptorKind, n: int = 20, seed: int = 1) -> SentKeyframe:
    rng = np.random.default_rng(seed)
    features = make_features(
        rng.uniform(0, [640, 480], (n, 2)),
        rng.uniform(0.3, 6.0, n),
        random_descriptors(kind, n, seed),
        kind=kind,
    )
    return SentKeyframe(
        timestamp_s=1.8e9,
        T_odom_camera=exp_se3([1.0, -2.0, 3.0, 0.1, 0.2, 0.3]),
        camera=CAMERA,
        features=features,
    )


def map_keyframe(kind: DescriptorKind, number: int = 0, n: int = 20) -> Keyframe:
    rng = np.random.default_rng(number)
    return Keyframe(
        id=number,
        robot="r",
        timestamp_s=float(number),
        T_world_camera=np.eye(4),
        camera=CAMERA,
        pixels=rng.uniform(0, 480, (n, 2)).astype(np.float32),
        descriptors=random_descriptors(kind, n, number),
        points_camera=rng.uniform(1, 3, (n, 3)).astype(np.float32),
        kind=kind,
    )


# --- distances ---------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_distances_are_exact_whole_numbers(kind: DescriptorKind) -> None:
    first, second = random_descriptors(kind, 40, 1), random_descriptors(kind, 40, 2)
    first[0], second[0] = (0, 255) if kind.dtype == "uint8" else (-128, 127)
    if kind.dtype == "uint8":
        oracle = np.unpackbits(first[:, None] ^ second[None], axis=2).sum(axis=2, dtype=np.int64)
    else:
        oracle = ((first[:, None].astype(np.int64) - second[None]) ** 2).sum(axis=2)

    assert np.array_equal(distance_matrix(first, second), oracle)
    assert np.array_equal(distances_of_pairs(first, second), np.diag(oracle))
    assert oracle.max() <= distance_bound(first)


@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_matches_are_the_nearest_by_the_ratio_and_one_to_one(kind: DescriptorKind) -> None:
    view = random_descriptors(kind, 60, 3)
    reference = view[[7, 20, 20, 41]].copy()
    reference[2, 0] ^= 1  # not as near to row 20 as row 1 is
    ambiguous = np.concatenate([view, view[41:42]])

    rows, columns = best_matches(reference, view, 0.8)
    assert sorted(zip(rows.tolist(), columns.tolist(), strict=True)) == [(0, 7), (1, 20), (3, 41)]
    rows, columns = best_matches(reference, ambiguous, 0.8)
    assert 3 not in rows.tolist()


def test_descriptors_of_two_kinds_are_not_compared() -> None:
    with pytest.raises(BadRequest, match="cannot be compared"):
        best_matches(random_descriptors(SIFT, 5), random_descriptors(XFEAT, 5), 0.8)
    with pytest.raises(BadRequest, match="cannot be compared"):
        best_matches(random_descriptors(ORB, 5).view(np.int8), random_descriptors(ORB, 5), 0.8)
    assert common_kind([], "x") == ORB
    with pytest.raises(BadRequest, match=r"the map has features of kind sift \(128 dimensions\)"):
        common_kind([SIFT, SIFT, XFEAT], "the map")


@pytest.mark.parametrize("kind", [SIFT, AKAZE], ids=str)
def test_features_near_a_pixel_are_matched_by_their_own_metric(kind: DescriptorKind) -> None:
    n = 12
    descriptors = random_descriptors(kind, n, 5)
    pixels = np.stack([40.0 * np.arange(n), np.full(n, 50.0)], axis=1)
    image = Features(
        pixels=pixels,
        descriptors=descriptors,
        orientations=np.zeros((n, 2)),
        sizes=np.full(n, 9.0),
        points_camera=np.full((n, 3), np.nan),
        distinctiveness=measure_distinctiveness(descriptors, pixels),
        is_oriented=False,
        is_scaled=False,
    )
    seen_again = descriptors.copy()
    seen_again[:, :8] ^= 7  # as far as another look of the same point: above 60 for a vector
    sought = PredictedFeatures(
        pixels=pixels + 3.0,
        descriptors=seen_again,
        orientations=np.tile([0.0, 1.0], (n, 1)),
        sizes=np.ones(n),
    )

    rows, columns = match_predictions(sought, image, GuidedMatchLimits(radius_px=10.0))
    oriented, _ = match_predictions(
        sought, replace(image, is_oriented=True), GuidedMatchLimits(radius_px=10.0)
    )
    scaled, _ = match_predictions(sought, replace(image, is_scaled=True), GuidedMatchLimits(radius_px=10.0))
    other = replace(sought, descriptors=random_descriptors(kind, n, 6))

    assert rows.tolist() == columns.tolist() == list(range(n))
    assert len(oriented) == len(scaled) == 0
    assert len(match_predictions(other, image, GuidedMatchLimits(radius_px=10.0))[0]) < 3


@pytest.mark.parametrize("kind", [SIFT, XFEAT, AKAZE], ids=str)
def test_a_place_is_recognised_by_descriptors_that_nothing_was_trained_for(kind: DescriptorKind) -> None:
    here, there = random_descriptors(kind, 400, 1), random_descriptors(kind, 400, 2)
    again = here.copy()
    again[::4] = random_descriptors(kind, 100, 3)

    vectors = [place_vector(each) for each in (here, again, there)]

    assert np.linalg.norm(vectors[0]) == pytest.approx(1.0, abs=1e-5)
    assert vectors[0] @ vectors[1] > 0.6 > 0.3 > vectors[0] @ vectors[2]
    assert np.array_equal(vectors[0], place_vector(here))
    assert not place_vector(here[:0]).any()


# --- keyframes ---------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_a_keyframe_of_any_kind_comes_back_as_it_was(kind: DescriptorKind) -> None:
    made = keyframe(kind, 2000)
    data = encode_keyframe(made)

    found = decode_keyframe(data)

    assert len(made.features) == max_features(kind) == {32: 894, 61: 507, 64: 485, 128: 253}[kind.size]
    assert len(data) <= MAX_KEYFRAME_BYTES - 1800
    assert found.features.kind == kind
    assert found.features.descriptors.dtype == kind.dtype
    assert np.array_equal(found.features.descriptors, made.features.descriptors)
    assert encode_keyframe(found) == data


def test_features_must_be_of_the_kind_that_is_named() -> None:
    for wrong in (
        random_descriptors(XFEAT, 3),
        random_descriptors(SIFT, 3).view(np.uint8),
        np.zeros(3, np.int8),
    ):
        with pytest.raises(BadRequest, match="do not fit features of sift"):
            make_features(np.ones((3, 2)), np.ones(3), wrong, kind=SIFT)


def changed(kind: DescriptorKind, at: int, form: str, value: float, *, name: bytes | None = None) -> bytes:
    data = bytearray(encode_keyframe(keyframe(kind)))
    struct.pack_into(form, data, FEATURES_AT + at, value)
    if name is not None:
        end = FEATURES_AT + 8 + 20 * (4 + kind.size) + len(kind.name)
        data[end - len(kind.name) : end] = name
    return bytes(data)


HOSTILE_KEYFRAMES = {
    "no detector": changed(SIFT, 0, "<B", 0),
    "ORB's detector with vectors": changed(SIFT, 0, "<B", 1),
    "a detector of tomorrow": changed(SIFT, 0, "<B", 3),
    "no metric": changed(SIFT, 1, "<B", 0),
    "a metric of tomorrow": changed(SIFT, 1, "<B", 3),
    "no size": changed(SIFT, 2, "<H", 0),
    "another size": changed(SIFT, 2, "<H", 64),
    "a huge size": changed(SIFT, 2, "<H", 65_535),
    "one feature more": changed(SIFT, 4, "<H", 21),
    "one feature less": changed(SIFT, 4, "<H", 19),
    "65,535 features": changed(SIFT, 4, "<H", 65_535),
    "a name of no length": changed(SIFT, 7, "<B", 0),
    "a name of 255 letters": changed(SIFT, 7, "<B", 255),
    "a name that is shorter": changed(SIFT, 7, "<B", 3),
    "capitals": changed(SIFT, 7, "<B", 4, name=b"SIFT"),
    "a path": changed(SIFT, 7, "<B", 4, name=b"../x"),
    "a line break": changed(SIFT, 7, "<B", 4, name=b"a\nbc"),
    "bytes that are no letters": changed(SIFT, 7, "<B", 4, name=b"\xff\xfe\x00\x01"),
    "named ORB": changed(DescriptorKind("abc", "uint8", 32), 7, "<B", 3, name=b"orb"),
    "a pixel outside": changed(SIFT, 8, "<H", 65_535),
}


@pytest.mark.parametrize("data", HOSTILE_KEYFRAMES.values(), ids=HOSTILE_KEYFRAMES)
def test_a_keyframe_with_hostile_descriptors_is_refused_in_one_line(data: bytes) -> None:
    with pytest.raises(BadRequest) as refused:
        decode_keyframe(data)
    assert refused.value.hint
    assert "\n" not in refused.value.message
    assert len(refused.value.message) < 200


def test_more_features_than_fit_are_refused() -> None:
    full = encode_keyframe(keyframe(XFEAT, 2000))
    too_small = DescriptorKind("tiny", "uint8", 4)
    made = keyframe(too_small, 2000).features
    assert len(made) == 894
    data = bytearray(encode_keyframe(replace(keyframe(ORB), features=made)))
    assert decode_keyframe(bytes(data)).features.kind == too_small
    assert len(full) < MAX_KEYFRAME_BYTES
    features = KeyframeOfMany(1000)
    with pytest.raises(BadRequest, match="1000 features of tiny"):
        decode_keyframe(features.data)


class KeyframeOfMany:
    """A keyframe of *n* tiny features, more than any robot makes."""

    def __init__(self, n: int) -> None:
        few = keyframe(DescriptorKind("tiny", "uint8", 4), 10).features
        many = replace(
            few,
            pixels=np.tile(few.pixels, (n // 10, 1)),
            depths_m=np.tile(few.depths_m, n // 10),
            descriptors=np.tile(few.descriptors, (n // 10, 1)),
        )
        self.data = encode_keyframe(replace(keyframe(ORB), features=many))


# --- maps --------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_a_map_of_any_kind_comes_back_as_it_was(kind: DescriptorKind) -> None:
    version = MapVersion(keyframes=(map_keyframe(kind, 0), map_keyframe(kind, 1)))

    found = decode_map(encode_map(version))

    assert found.kind == kind
    for one, other in zip(found.keyframes, version.keyframes, strict=True):
        assert np.array_equal(one.descriptors, other.descriptors)
        assert one.descriptors.dtype == other.descriptors.dtype
    assert encode_map(found) == encode_map(version)


def test_two_kinds_do_not_meet_in_a_map_or_a_merge() -> None:
    with pytest.raises(BadRequest, match="the map has features of kind sift"):
        MapVersion(keyframes=(map_keyframe(SIFT, 0), map_keyframe(XFEAT, 1)))
    one, other = (MapVersion(keyframes=(map_keyframe(kind),)) for kind in (SIFT, ORB))
    with pytest.raises(BadRequest, match=r"the first map has features of kind sift .*cannot take orb"):
        Atlas.of([one, other])
    Atlas.of([one, MapVersion(keyframes=()), one])


def with_features(features: Any, kind: DescriptorKind = SIFT) -> bytes:
    data = encode_map(MapVersion(keyframes=(map_keyframe(kind),)))
    fields = msgspec.msgpack.decode(zlib.decompress(data[8:]))
    fields["features"] = features
    return data[:8] + zlib.compress(msgspec.msgpack.encode(fields))


HOSTILE_MAPS = {
    "no kind for vectors": with_features(None),
    "another size": with_features(["sift", "int8", 100]),
    "no size": with_features(["sift", "int8", 0]),
    "a negative size": with_features(["sift", "int8", -128]),
    "a huge size": with_features(["sift", "int8", 2**40]),
    "a size that is a number with a point": with_features(["sift", "int8", 128.5]),
    "objects": with_features(["sift", "O", 128]),
    "floats": with_features(["sift", "float32", 32]),
    "a structure": with_features(["sift", "i4,i4", 16]),
    "no name": with_features(["", "int8", 128]),
    "a long name": with_features(["s" * 10_000, "int8", 128]),
    "a name with a line break": with_features(["a\nb", "int8", 128]),
    "too few parts": with_features(["sift", "int8"]),
    "a mapping": with_features({"name": "sift"}),
    "nested lists": with_features([[[[["sift"]]]]]),
    "bytes": with_features(b"sift"),
    "64 for 128": with_features(["sift", "int8", 64]),
}


@pytest.mark.parametrize("data", HOSTILE_MAPS.values(), ids=HOSTILE_MAPS)
def test_a_map_with_hostile_descriptors_is_refused_in_one_line(data: bytes) -> None:
    with pytest.raises((BadRequest, LimitExceeded)) as refused:
        decode_map(data)
    assert refused.value.hint
    assert "\n" not in refused.value.message
    assert len(refused.value.message) < 300


# --- services ----------------------------------------------------------------------------------

REGISTRY = builtin_services(PlatformSettings())
SIFT_MAP = encode_map(MapVersion(keyframes=(map_keyframe(SIFT, 0, 60), map_keyframe(SIFT, 1, 60))))


def asked(service: str, kind: DescriptorKind, **other: Any) -> Result | Failure:
    own = map_keyframe(kind, 0, 60)
    payload = {
        "map": SIFT_MAP,
        "camera": msgspec.to_builtins(CAMERA),
        "pixels": own.pixels.ravel(),
        "descriptors": own.descriptors.tobytes(),
        "features": {"name": kind.name, "dtype": kind.dtype, "size": kind.size},
        **other,
    }
    return dispatch(REGISTRY, Command(id=1, service=service, payload=payload), time.monotonic)


def test_a_view_of_the_same_kind_is_found() -> None:
    answer = asked("place", SIFT, check=False)

    assert isinstance(answer, Result), answer
    assert [each["keyframe"] for each in msgspec.to_builtins(answer.reply)["candidates"]] == [0, 1]


@pytest.mark.parametrize("service", ["place", "localise"])
@pytest.mark.parametrize(
    ("kind", "other", "why"),
    [
        (XFEAT, {}, "the map has features of kind sift"),
        (ORB, {"features": None}, "cannot take orb"),
        (DescriptorKind("fish", "int8", 128), {}, r"cannot take fish \(128 dimensions\)"),
        (SIFT, {"descriptors": bytes(127)}, "127 bytes are not 60 descriptors of 128 bytes"),
        (SIFT, {"features": {"name": "sift", "dtype": "object", "size": 128}}, "are not known"),
        (SIFT, {"features": {"name": "sift", "dtype": "int8", "size": 2**40}}, "are not known"),
        (SIFT, {"features": {"name": "S" * 9999, "dtype": "int8", "size": 128}}, "is no name of features"),
        (SIFT, {"features": "sift"}, "features"),
    ],
)
def test_a_view_of_another_kind_is_refused(
    service: str, kind: DescriptorKind, other: dict[str, Any], why: str
) -> None:
    answer = asked(service, kind, **other)

    assert isinstance(answer, Failure)
    assert answer.code == "bad-request"
    assert "\n" not in answer.message
    assert re.search(why, answer.message), answer.message


# --- live maps ---------------------------------------------------------------------------------


def added(robot: str, number: int, kind: DescriptorKind) -> KeyframeAdded:
    return KeyframeAdded(
        robot=robot, segment=0, number=number, data=encode_keyframe(keyframe(kind, 40, number + 1))
    )


def test_a_live_map_takes_one_kind_until_all_of_it_is_forgotten() -> None:
    live = LiveMap()
    assert live.kind is None
    for number in range(2):
        assert live.check_keyframe(added("a", number, SIFT)) == "new"
        live.apply(added("a", number, SIFT))

    for other in (ORB, XFEAT, DescriptorKind("other", "int8", 128)):
        with pytest.raises(BadRequest, match=r"the live map has features of kind sift"):
            live.check_keyframe(added("b", 0, other))
        with pytest.raises(BadRequest, match=r"the live map has features of kind sift"):
            live.relocalise(keyframe(other, 40))
    assert live.check_keyframe(added("b", 0, SIFT)) == "new"
    assert live.relocalise(keyframe(SIFT, 40)).verdict in ("ok", "weak", "none")

    restored = LiveMap.restore(live.snapshot())
    assert restored.kind == live.kind == SIFT
    for each in (live, restored):
        each.apply(RobotForgotten(robot="a"))
        assert each.kind is None
        assert each.check_keyframe(added("b", 0, XFEAT)) == "new"


def test_a_version_of_a_live_map_keeps_its_kind_and_starts_another_one() -> None:
    live = LiveMap()
    for number in range(3):
        live.apply(added("a", number, SIFT))

    version = decode_map(encode_map(live.to_version()))
    again = LiveMap()
    again.apply(started_from(version, "m@1"))

    assert version.kind == again.kind == SIFT
    with pytest.raises(BadRequest, match="features of kind sift"):
        again.check_keyframe(added("b", 0, ORB))
