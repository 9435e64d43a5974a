"""rse-pf map localise at a platform: what it sends, what it prints, and what it refuses in one line."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rse_pf.cli.main import main
from rse_pf.errors import NotFound
from rse_pf.identity import RobotId
from rse_pf.maps.photos import MapOutline, PhotoLens, PhotoLocation
from rse_pf.storage.object_store import MemoryStore
from tests.kit.fake_data_service import HttpServer, Service, small_settings

POSE = [[1.0, 0.0, 0.0, 1.5], [0.0, 1.0, 0.0, -2.0], [0.0, 0.0, 1.0, 0.25], [0.0, 0.0, 0.0, 1.0]]
OK = PhotoLocation(
    version="ab", verdict="ok", T_map_camera=POSE, covariance=[[0.0] * 6] * 6, position_sigma_m=0.01,
    turn_sigma_deg=0.2, inliers=99, rmse_px=0.7, keyframes=[4],
)  # fmt: skip
CALIBRATED = {"fx": 500.0, "fy": 501.0, "cx": 320.5, "cy": 0.0, "width": 640, "height": 480}


class Localiser:
    """Answers as a map would: photos that begin with ``k`` are known."""

    count = 1

    def __init__(self) -> None:
        self.asked: list[tuple[str, bytes, PhotoLens]] = []

    def localise(
        self, robot: RobotId, name: str, photo: bytes, lens: PhotoLens, charge: Any
    ) -> PhotoLocation:
        self.asked.append((name, photo, lens))
        if name != "kitchen":
            raise NotFound(f"there is no map {name!r}", hint="see rse-pf map list")
        return OK if photo.startswith(b"k") else PhotoLocation(version="ab", verdict="lost", reason="no-pose")

    def outline(self, robot: RobotId, name: str, charge: Any) -> MapOutline:
        raise NotFound("none")

    def close(self) -> None:
        """End nothing."""


class Platform:
    """A data service on a port, and the files that a user has."""

    def __init__(self, folder: Path) -> None:
        self.localiser = Localiser()
        service = Service(small_settings(), MemoryStore(), localiser=self.localiser)
        self.server = HttpServer(service)
        lens = {**CALIBRATED, "distortion": [0.1, -0.2, 0.0, 1e-5, 0.3]}
        files = {"known.jpg": "k", "strange.jpg": "s", "intrinsics.json": json.dumps(lens)}
        files["phone.token"] = service.token() + "\n"
        for name, text in files.items():
            (folder / name).write_text(text)
        (folder / "empty").mkdir()

    def run(self, *words: str) -> int:
        return main(["map", "localise", *words, "--url", self.server.url, "--token-file", "phone.token"])


@pytest.fixture
def platform(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Platform]:
    monkeypatch.chdir(tmp_path)
    made = Platform(tmp_path)
    with made.server:
        yield made


def test_photos_are_sent_with_the_lens_and_each_has_a_line(
    platform: Platform, capsys: pytest.CaptureFixture[str]
) -> None:
    code = platform.run("kitchen", "known.jpg", "strange.jpg", "--intrinsics", "intrinsics.json")

    lines = capsys.readouterr().out.splitlines()
    assert code == 0
    assert lines[0].startswith(
        "known.jpg                ok    x   1.500  y  -2.000  z   0.250 m, sigma 0.010 m, turned   0.00"
    )
    assert "lost  no-pose" in lines[1]
    assert lines[2] == "1 of 2 found"
    name, photo, lens = platform.localiser.asked[0]
    assert (name, photo) == ("kitchen", b"k")
    assert lens == PhotoLens(**CALIBRATED, distortion=(0.1, -0.2, 0.0, 1e-5, 0.3))


def test_json_has_the_pose_with_its_quality(platform: Platform, capsys: pytest.CaptureFixture[str]) -> None:
    assert platform.run("kitchen", "known.jpg", "--camera", "500,500,320,240", "--json") == 0

    (found,) = json.loads(capsys.readouterr().out)
    assert found["T_map_camera"] == POSE
    assert (found["position_sigma_m"], found["turn_sigma_deg"], found["version"]) == (0.01, 0.2, "ab")
    assert platform.localiser.asked[0][2] == PhotoLens(fx=500.0, fy=500.0, cx=320.0, cy=240.0)


def test_the_exit_code_is_1_if_no_photo_is_found(platform: Platform) -> None:
    assert platform.run("kitchen", "strange.jpg", "--camera", "500,500,320,240") == 1


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["kitchen", "known.jpg"], "--intrinsics FILE, or --camera"),
        (["kitchen", "known.jpg", "--camera", "1,2,3,4", "--intrinsics", "intrinsics.json"], "not both"),
        (["kitchen", "known.jpg", "--camera", "1,2,3"], "not four numbers"),
        (["kitchen", "none.jpg", "--camera", "1,2,3,4"], "none.jpg"),
        (["kitchen", "empty", "--camera", "1,2,3,4"], "empty"),
        (["kitchen", "known.jpg", "--camera", "1,2,3,4", "--store", "dir:x"], "--store"),
        (["kitchen", "known.jpg", "--camera", "1,2,3,4", "--enrolment", "x"], "--enrolment names"),
        (["kitchen", "known.jpg", "--intrinsics", "none.json"], "none.json"),
        (["kitchen", "known.jpg", "--camera", "1,2,3,4", "--authority", "phone.token"], "not a certificate"),
        (["garage", "known.jpg", "--camera", "1,2,3,4"], "there is no map 'garage'"),
        (["../maps", "known.jpg", "--camera", "1,2,3,4"], ""),
    ],
)
def test_what_cannot_work_is_one_line_with_a_hint(
    platform: Platform, capsys: pytest.CaptureFixture[str], words: list[str], said: str
) -> None:
    assert platform.run(*words) in (1, 2)

    told = capsys.readouterr().err
    assert said in told
    assert "hint: " in told
    assert "Traceback" not in told


def test_options_of_a_platform_need_its_address(
    platform: Platform, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["map", "localise", "kitchen", "known.jpg", "--url", platform.server.url]) == 2
    assert "--camera" in capsys.readouterr().err
    words = ["map", "localise", "kitchen", "known.jpg", "--intrinsics", "x", "--store", "dir:."]
    assert main(words) == 2
    assert "add --url" in capsys.readouterr().err
