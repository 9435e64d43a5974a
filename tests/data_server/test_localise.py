"""Photos at the data service: localised in a map of the tenant, in a process that may be killed."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

cv2 = pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")
from client_sdk.frontend import Frame, FrontEndOptions, extract  # noqa: E402
from client_sdk.simulator import make_world, render_along, true_trajectory  # noqa: E402
from rse_pf.data_server.photo_localiser import make_handler  # noqa: E402
from rse_pf.geometry import Array, pose_difference  # noqa: E402
from rse_pf.maps.format import Keyframe, MapVersion, decode_map, encode_map  # noqa: E402
from rse_pf.maps.registry import MapRegistry  # noqa: E402
from rse_pf.storage.object_store import DirectoryStore  # noqa: E402
from tests.kit.fake_data_service import Answer, Service, small_settings  # noqa: E402
from tests.kit.hostile_images import HARMLESS, hostile_images  # noqa: E402

pytestmark = pytest.mark.timeout(120)

PATH = "/localise/rooms"
LENS = "fx=525&fy=525&cx=319.5&cy=239.5"
FRAMES = 8
SEED = 3


class Drive:
    """A drive through rendered rooms: every second frame is a keyframe of the map, the others are photos."""

    def __init__(self) -> None:
        truth = true_trajectory(0, 1, FRAMES, SEED)
        self.poses: Array = truth.T_world_camera
        self.frames = list(render_along(truth, make_world(SEED), (SEED, 0)))
        keyframes = [_keyframe(row, self.frames[row], self.poses[row]) for row in range(0, FRAMES, 2)]
        points = np.arange(30_000, dtype=np.float32).reshape(-1, 3) / 1e4
        colours = np.zeros((len(points), 3), np.uint8)
        self.map = encode_map(MapVersion(keyframes=tuple(keyframes), points=points, colours=colours))

    def photo(self, row: int, *, scale: float = 1.0, kind: str = ".jpg") -> bytes:
        image = cv2.resize(self.frames[row].rgb[:, :, ::-1], None, fx=scale, fy=scale)
        return bytes(cv2.imencode(kind, image)[1])

    def is_right(self, answer: Answer, row: int) -> bool:
        assert answer.status == 200, answer.body
        metres, degrees = pose_difference(np.array(answer.json["T_map_camera"]), self.poses[row])
        return answer.json["verdict"] == "ok" and metres < 0.03 and degrees < 1.0


def _keyframe(number: int, frame: Frame, T_map_camera: Array) -> Keyframe:
    features = extract(frame, FrontEndOptions())
    return Keyframe(
        id=number, robot="r", timestamp_s=frame.timestamp_s, camera=frame.camera, T_world_camera=T_map_camera,
        pixels=features.pixels.astype(np.float32), descriptors=features.descriptors,
        points_camera=features.points_camera.astype(np.float32),
    )  # fmt: skip


@pytest.fixture(scope="module")
def drive() -> Drive:
    return Drive()


class PhotoService(Service):
    """A data service whose processes are shared by all tests of this file, and seen."""

    def ask(self, *args: Any, **kwargs: Any) -> Answer:
        self.now += 10.0  # no rate limit is reached
        return super().ask(*args, **kwargs)

    def localise(self, data: bytes, *, path: str = PATH, query: str = LENS, **kwargs: Any) -> Answer:
        return self.ask("POST", path, data, query=query, **kwargs)


@pytest.fixture(scope="module")
def service(drive: Drive, tmp_path_factory: pytest.TempPathFactory) -> Iterator[PhotoService]:
    folder = tmp_path_factory.mktemp("store")
    settings = small_settings(
        store=f"dir:{folder}", part_bytes=1 << 20, max_object_bytes=1 << 28, max_requests_per_s=1000
    )
    made = PhotoService(settings, DirectoryStore(folder))
    maps = MapRegistry(made.store, "default")
    maps.commit("rooms", drive.map, parent=None, author="test", created_s=0.0)
    maps.commit("empty", encode_map(MapVersion(keyframes=())), parent=None, author="test", created_s=0.0)
    yield made
    made.app.close()


def test_a_photo_is_found_with_its_covariance(service: PhotoService, drive: Drive) -> None:
    answer = service.localise(drive.photo(3))

    assert drive.is_right(answer, 3)
    found = answer.json
    assert found["version"] == MapRegistry(service.store, "default").head("rooms").id
    covariance = np.array(found["covariance"])
    assert covariance.shape == (6, 6)
    assert (np.linalg.eigvalsh(covariance) > 0).all()
    metres, degrees = pose_difference(np.array(found["T_map_camera"]), drive.poses[3])
    assert metres / 3 < found["position_sigma_m"] < 0.05
    assert degrees / 3 < found["turn_sigma_deg"] < 2.0
    assert found["inliers"] >= 30
    assert set(found["keyframes"]) <= set(range(FRAMES))


@pytest.mark.parametrize(
    ("scale", "kind", "query"),
    [
        (2.0, ".jpg", "fx=1050&fy=1050&cx=639.5&cy=479.5"),
        (1.5, ".png", LENS + "&width=640&height=480"),
        (1.0, ".jpg", LENS + "&distortion=0,0,0,0,0&model=radial-tangential"),
        (1.0, ".jpg", LENS + "&distortion=&width=640&height=480"),
    ],
)
def test_a_photo_of_another_size_is_found_at_the_same_place(
    service: PhotoService, drive: Drive, scale: float, kind: str, query: str
) -> None:
    assert drive.is_right(service.localise(drive.photo(5, scale=scale, kind=kind), query=query), 5)


@pytest.mark.parametrize("model", ["radial-tangential", "fisheye"])
def test_the_distortion_of_a_lens_is_taken_out(service: PhotoService, drive: Drive, model: str) -> None:
    numbers = np.array([-0.25, 0.06, 0.001, -0.001] if model != "fisheye" else [0.05, -0.01, 0.0, 0.0])
    matrix = drive.frames[1].camera.matrix
    grid = np.stack(np.meshgrid(np.arange(640.0), np.arange(480.0)), axis=-1).reshape(-1, 1, 2)
    undistort = cv2.fisheye.undistortPoints if model == "fisheye" else cv2.undistortPoints
    straight = undistort(grid, matrix, numbers, None, None, matrix).reshape(480, 640, 2).astype(np.float32)
    bent = cv2.remap(drive.frames[1].rgb[:, :, ::-1], straight, None, cv2.INTER_LINEAR)
    data = bytes(cv2.imencode(".png", bent)[1])
    told = LENS + f"&model={model}&distortion={','.join(map(str, numbers))}"

    assert drive.is_right(service.localise(data, query=told), 1)
    untold = service.localise(data)
    assert untold.json["verdict"] != "ok" or not drive.is_right(untold, 1)


@pytest.mark.parametrize(
    ("first_px", "factor"),
    [(0, 0.6), (0, 0.8), (0, 0.9), (0, 0.95), (0, 1.05), (0, 1.1), (0, 1.4), (64, 1.0), (100, 1.0)],
)
def test_a_photo_with_another_camera_is_weak_or_knows_its_error(
    service: PhotoService, drive: Drive, first_px: int, factor: float
) -> None:
    """Cut *first_px* columns and rows in the shape of the photo, and multiply the focal length."""
    image = drive.frames[3].rgb[first_px * 3 // 4 :, first_px:, ::-1]
    cropped = bytes(cv2.imencode(".jpg", cv2.resize(image, (640, 480)))[1])

    answer = service.localise(cropped, query=f"fx={525 * factor}&fy={525 * factor}&cx=319.5&cy=239.5").json

    if abs(factor - 1.0) >= 0.1 or first_px:
        assert answer["verdict"] in ("weak", "lost"), answer
    if answer["verdict"] == "ok":
        metres, _ = pose_difference(np.array(answer["T_map_camera"]), drive.poses[3])
        assert metres < max(0.05, 3.0 * answer["position_sigma_m"])


@pytest.mark.parametrize(
    ("query", "status", "code"),
    [
        ("", 400, "bad-request"), ("fx=525&fy=525&cx=319.5", 400, "bad-request"),
        (LENS.replace("525", "x"), 400, "bad-request"), (LENS.replace("525", "nan"), 400, "invalid-camera"),
        (LENS.replace("525", "-525"), 400, "invalid-camera"), (LENS.replace("525", "1e400"), 400, None),
        (LENS + "&width=640", 400, "bad-request"), (LENS + "&width=640&height=640", 400, "bad-request"),
        (LENS + "&width=-640&height=-480", 400, "bad-request"), (LENS + "&width=0x1&height=1", 400, None),
        (LENS + "&distortion=1,2", 400, "bad-request"), (LENS + "&distortion=nan,0,0,0", 400, "bad-request"),
        (LENS + "&distortion=" + "0," * 5000, 400, "bad-request"), (LENS + "&model=magic", 400, None),
        (LENS + "&distortion=1,1,1,1,1&model=fisheye", 400, "bad-request"),
        (LENS + "&distortion=1e9,0,0,0", 400, "bad-request"),
    ],
)  # fmt: skip
def test_a_lens_that_is_none_is_refused_in_one_line(
    service: PhotoService, drive: Drive, query: str, status: int, code: str | None
) -> None:
    answer = service.localise(drive.photo(3), query=query)

    assert answer.status == status, answer.body
    assert code in (None, answer.json["code"])
    assert "\n" not in answer.json["message"]
    assert answer.json["hint"]


@pytest.mark.parametrize("numbers", ["1000,0,0,0", "-1000,1000,0,0", "0,0,1000,-1000,1000"])
@pytest.mark.parametrize("model", ["radial-tangential", "fisheye"])
def test_an_absurd_lens_finds_nothing(service: PhotoService, drive: Drive, numbers: str, model: str) -> None:
    told = ",".join(numbers.split(",")[:4]) if model == "fisheye" else numbers
    answer = service.localise(drive.photo(3), query=f"{LENS}&model={model}&distortion={told}")

    assert (answer.status, answer.json["verdict"] != "ok") == (200, True)


def test_maps_that_do_not_exist_are_empty_or_belong_to_others_are_refused(
    service: PhotoService, drive: Drive
) -> None:
    assert service.localise(drive.photo(3), path="/localise/other").status == 404
    assert service.localise(drive.photo(3), path="/localise/..%2Frooms").status in (400, 404)
    assert service.localise(drive.photo(3), path="/localise/empty").status == 413
    stranger = service.token("robot-1", "rival")
    assert service.localise(drive.photo(3), token=stranger).status == 404
    assert service.ask("GET", PATH, token=stranger).status == 404


@pytest.mark.parametrize(
    ("scope", "status"),
    [
        ("maps:localise/rooms", 200), ("maps:localise", 200), ("maps:*/rooms", 200), ("maps:*", 200),
        ("maps:localise/other", 403), ("maps:read", 403), ("maps:live/rooms", 403),
    ],
)  # fmt: skip
def test_a_token_needs_the_scope_of_the_map(
    service: PhotoService, drive: Drive, scope: str, status: int
) -> None:
    token = service.token(scopes=(scope,))

    assert service.localise(drive.photo(3), token=token).status == status
    assert service.ask("GET", PATH, token=token).status == status
    assert service.ask("GET", "/data/v1/maps", token=service.token(scopes=("maps:localise",))).status == 403


def test_an_outline_shows_the_map_from_above(service: PhotoService, drive: Drive) -> None:
    answer = service.ask("GET", PATH)

    assert answer.status == 200
    axes = np.array(answer.json["top_view"])
    np.testing.assert_allclose(axes @ axes.T, np.eye(2), atol=1e-9)
    up = np.cross(axes[0], axes[1])
    assert up @ -drive.poses[:, :3, 1].mean(axis=0) > 0.9
    places = drive.poses[::2, :3, 3] @ axes.T
    np.testing.assert_allclose(np.array(answer.json["keyframes"]), places, atol=1e-3)
    assert 1000 < len(answer.json["points"]) <= 4000


def test_a_new_head_is_used_at_once(drive: Drive, tmp_path: Path) -> None:
    store = DirectoryStore(tmp_path)
    settings = small_settings(store=f"dir:{tmp_path}")
    maps = MapRegistry(store, "default")
    first = maps.commit("m", drive.map, parent=None, author="t", created_s=0.0)
    handler = make_handler(json.dumps(settings.to_dict()))
    asked = msgspec.msgpack.encode({"tenant": "default", "name": "m"})

    before = msgspec.msgpack.decode(handler(asked))
    assert before["version"] == first.id
    map_version = decode_map(drive.map)
    T_new_world = np.eye(4)
    T_new_world[:3, 3] = [1.0, 2.0, 3.0]
    moved = tuple(
        replace(each, T_world_camera=T_new_world @ each.T_world_camera) for each in map_version.keyframes
    )
    encoded = encode_map(replace(map_version, keyframes=moved))
    second = maps.commit("m", encoded, parent=first.id, author="t", created_s=1.0)
    after = msgspec.msgpack.decode(handler(asked))
    assert after["version"] == second.id
    by = np.array(after["keyframes"]) - np.array(before["keyframes"])
    np.testing.assert_allclose(by, [np.array(after["top_view"]) @ T_new_world[:3, 3]] * len(by), atol=1e-3)


def test_the_maps_of_one_tenant_do_not_displace_those_of_another(
    drive: Drive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[int] = []

    def index_map(data: bytes) -> tuple[MapVersion, None]:
        read.append(len(data))
        return decode_map(drive.map), None

    monkeypatch.setattr("rse_pf.services.mapping.place.index_map", index_map)
    store = DirectoryStore(tmp_path)
    settings = small_settings(store=f"dir:{tmp_path}")
    for tenant, count in (("default", 1), ("rival", 5)):
        for number in range(count):
            maps = MapRegistry(store, tenant)
            maps.commit(f"m{number}", drive.map, parent=None, author="t", created_s=0.0)
    handler = make_handler(json.dumps(settings.to_dict()))

    def ask(tenant: str, name: str) -> int:
        before = len(read)
        handler(msgspec.msgpack.encode({"tenant": tenant, "name": name}))
        return len(read) - before

    assert ask("default", "m0") == 1
    assert [ask("rival", f"m{number}") for number in range(5)] == [1] * 5
    assert ask("default", "m0") == 0
    assert ask("rival", "m4") == 0
    assert ask("rival", "m0") == 1


def test_hostile_images_are_refused_and_the_process_lives(service: PhotoService, drive: Drive) -> None:
    quick = {name: data for name, data in hostile_images().items() if len(data) < 100_000}
    assert len(quick) >= 50
    assert service.localise(drive.photo(3)).status == 200

    for number, (name, data) in enumerate(quick.items()):
        answer = service.localise(data, robot=f"hostile-{number}")
        if name.startswith(HARMLESS):
            assert answer.status in (200, 400), name
            assert answer.json.get("verdict", "lost") == "lost", name
        else:
            assert answer.status in (400, 413), name
            assert re.fullmatch(r"bad-request|too-large|invalid-camera", answer.json["code"]), name
    assert drive.is_right(service.localise(drive.photo(3)), 3)
    assert not [line for line in service.lines if line.get("code") in ("crashed", "internal")]


def test_a_robot_that_floods_is_told_to_wait_and_others_are_served(
    service: PhotoService, drive: Drive
) -> None:
    settings = small_settings(store=service.settings.data.store, part_bytes=1 << 20, max_requests_per_s=50)
    flooded = Service(settings, service.store)
    try:
        statuses = [
            flooded.ask("POST", PATH, drive.photo(3), query=LENS, robot="flood").status for _ in range(30)
        ]
        assert 10 <= statuses.count(200) < 30
        assert set(statuses) == {200, 429}
        assert flooded.ask("POST", PATH, drive.photo(3), query=LENS, robot="other").status == 200
    finally:
        flooded.app.close()
