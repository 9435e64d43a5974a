"""The page that localises its camera, in Chromium and behind the load balancer of a platform.

The camera is a film of the drive that made the map.
"""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest

from tests.examples.conftest import ExamplePlatform, Program
from tests.examples.conftest import platform as platform
from tests.kit.chromium import chromium, film_as_camera

cv2 = pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")
from client_sdk.frontend import FrontEndOptions, extract  # noqa: E402
from client_sdk.simulator import make_world, render_along, true_trajectory  # noqa: E402
from client_sdk.transfer.data_client import DataClient  # noqa: E402
from rse_pf.cli.main import main  # noqa: E402
from rse_pf.config import PlatformSettings  # noqa: E402
from rse_pf.geometry import Array  # noqa: E402
from rse_pf.local.firewall import ensure_key  # noqa: E402
from rse_pf.maps.format import Keyframe, MapVersion, encode_map  # noqa: E402

pytestmark = [pytest.mark.slow, pytest.mark.system, pytest.mark.timeout(300)]

REPOSITORY = Path(__file__).resolve().parents[2]
FRAMES, HOLD, SEED = 6, 10, 5
HAS_DATA = True
with socket.create_server(("127.0.0.1", 0)) as _free:
    PORT = _free.getsockname()[1]
ALLOWED_ORIGINS = f"http://localhost:{PORT}"


@pytest.fixture(scope="module")
def places(platform: ExamplePlatform) -> Array:
    """The true places of the film's frames; the map is committed, and film and photos are in the folder."""
    truth = true_trajectory(0, 1, FRAMES, SEED)
    keyframes = []
    with (platform.folder / "film.mjpeg").open("wb") as film:
        for row, frame in enumerate(render_along(truth, make_world(SEED), (SEED, 0))):
            found = extract(frame, FrontEndOptions())
            keyframes.append(
                Keyframe(
                    id=row, robot="r", timestamp_s=float(row), camera=frame.camera,
                    T_world_camera=truth.T_world_camera[row], pixels=found.pixels.astype(np.float32),
                    descriptors=found.descriptors, points_camera=found.points_camera.astype(np.float32),
                )
            )  # fmt: skip
            jpeg = cv2.imencode(".jpg", frame.rgb[:, :, ::-1], (cv2.IMWRITE_JPEG_QUALITY, 95))[1].tobytes()
            (platform.folder / f"photo-{row}.jpg").write_bytes(jpeg)
            film.write(jpeg * HOLD)
    client = DataClient.enrolled(platform.folder / "robot-1.enrolment")
    client.update_map("rooms", encode_map(MapVersion(keyframes=tuple(keyframes))))
    client.close()
    return truth.T_world_camera[:, :3, 3]


@pytest.fixture(scope="module")
def token(platform: ExamplePlatform) -> str:
    """A token for photos of the map, and nothing else."""
    key = ensure_key(platform.cloud.state, seed=b"w" * 32, key_id="unused")
    settings, scopes = PlatformSettings().auth, ("maps:localise/rooms",)
    return key.issue("phone", now=time.time(), token_id="t", settings=settings, scopes=scopes)


@pytest.fixture
def page() -> Iterator[str]:
    """The page, served as its text says."""
    words = [sys.executable, str(REPOSITORY / "examples" / "web" / "serve.py"), "--port", str(PORT)]
    program = Program(subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True))
    program.until("http")
    yield f"http://localhost:{PORT}/place"
    program.end()


def test_photos_are_localised_through_the_load_balancer(
    platform: ExamplePlatform, places: Array, token: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (platform.folder / "phone.token").write_text(token)
    photos = [str(platform.folder / f"photo-{row}.jpg") for row in range(FRAMES)]
    told = ["--url", f"http://127.0.0.1:{platform.cloud.port}", "--camera", "525,525,319.5,239.5", "--json"]
    words = ["map", "localise", "rooms", *photos, *told]

    assert main([*words, "--token-file", str(platform.folder / "phone.token")]) == 0

    found = json.loads(capsys.readouterr().out)
    assert [each["verdict"] for each in found] == ["ok"] * FRAMES
    localised = np.array([each["T_map_camera"] for each in found])[:, :3, 3]
    assert np.linalg.norm(localised - places, axis=1).max() < 0.05


def test_the_page_shows_its_place_and_asks_no_other_host(
    platform: ExamplePlatform, places: Array, token: str, page: str
) -> None:
    asked: set[str] = set()
    wrong: list[str] = []
    with chromium(*film_as_camera(platform.folder / "film.mjpeg")) as browser:
        window = browser.new_page()
        window.on("pageerror", lambda error: wrong.append(str(error)))
        window.on("request", lambda request: asked.add(urlsplit(request.url).netloc))
        window.goto(f"{page}#map=rooms&url=http://127.0.0.1:{platform.cloud.port}")
        window.fill("#token", token)
        window.click("button")
        window.wait_for_function("document.querySelector('output').dataset.drawn", timeout=60_000)
        said = window.inner_text("output")
        found = json.loads(window.evaluate("document.querySelector('output').dataset.found"))
        drawn = json.loads(window.evaluate("document.querySelector('output').dataset.drawn"))
        red = window.evaluate(
            "([x, y]) => [...document.querySelector('canvas').getContext('2d')"
            ".getImageData(x, y, 1, 1).data].slice(0, 3)", drawn,
        )  # fmt: skip

    assert wrong == []
    assert said.startswith("ok ")
    place = np.array(found["T_map_camera"])[:3, 3]
    assert np.linalg.norm(places - place, axis=1).min() < 0.05
    np.testing.assert_allclose(red, [0xDD, 0x33, 0x33], atol=2)  # the canvas rounds
    assert asked == {f"localhost:{PORT}", f"127.0.0.1:{platform.cloud.port}"}
