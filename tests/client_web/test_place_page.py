"""The page that localises its camera, in Chromium: the camera is a film of the drive that made the map."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest

cv2 = pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")
pytest.importorskip("faiss", reason="pip install 'rse-pf[maps]'")
from client_sdk.frontend import FrontEndOptions, extract  # noqa: E402
from client_sdk.simulator import make_world, render_along, true_trajectory  # noqa: E402
from rse_pf.auth.tokens import SigningKey  # noqa: E402
from rse_pf.config import PlatformSettings  # noqa: E402
from rse_pf.maps.format import Keyframe, MapVersion, encode_map  # noqa: E402
from rse_pf.maps.registry import MapRegistry  # noqa: E402
from rse_pf.object_store import DirectoryStore  # noqa: E402
from tests.examples.conftest import Program  # noqa: E402

pytestmark = [pytest.mark.slow, pytest.mark.system, pytest.mark.timeout(180)]

REPOSITORY = Path(__file__).resolve().parents[2]
FRAMES, HOLD, SEED = 6, 10, 5
KEY = SigningKey.from_seed(b"w" * 32, "key-1")
_WORDS = [sys.executable, "-m", "rse_pf.cli.main", "data"]


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])


@pytest.fixture
def places(tmp_path: Path) -> np.ndarray:
    """The true places of the film's frames; the map and the film are in the folder."""
    truth = true_trajectory(0, 1, FRAMES, SEED)
    keyframes = []
    with (tmp_path / "film.mjpeg").open("wb") as film:
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
            film.write(jpeg * HOLD)
    MapRegistry(DirectoryStore(tmp_path / "store")).commit(
        "rooms", encode_map(MapVersion(keyframes=tuple(keyframes))), parent=None, author="t", created_s=0.0
    )
    return truth.T_world_camera[:, :3, 3]


@pytest.fixture
def ports(tmp_path: Path, places: np.ndarray) -> Iterator[tuple[int, int]]:
    """The ports of a data service with the map, and of the page."""
    page_port = free_port()
    settings = PlatformSettings().replace(
        data={"store": f"dir:{tmp_path / 'store'}", "port": 0},
        serving={"allowed_origins": f"http://localhost:{page_port}"},
    )
    (tmp_path / "keys.json").write_text(KEY.key_set().to_json())
    (tmp_path / "settings.json").write_text(json.dumps({"context": {"rse-pf": settings.to_dict()}}))
    files = {"settings": "settings.json", "keys": "keys.json"}
    words = [*_WORDS, *(f"--{option}={tmp_path / name}" for option, name in files.items())]
    served = [sys.executable, str(REPOSITORY / "examples" / "web" / "serve.py"), "--port", str(page_port)]
    programs = [
        Program(subprocess.Popen(each, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True))
        for each in (words, served)
    ]
    try:
        ready = json.loads(programs[0].until('"ready"'))
        programs[1].until("http")
        yield ready["port"], page_port
    finally:
        for program in programs:
            program.end()


def test_the_page_shows_its_place_and_asks_no_other_host(
    ports: tuple[int, int], places: np.ndarray, tmp_path: Path
) -> None:
    sync_api = pytest.importorskip("playwright.sync_api", reason="no playwright: make browser installs it")
    chromium = next(filter(None, map(shutil.which, ("chromium-headless-shell", "chromium"))), None)
    if chromium is None:
        pytest.skip("no Chromium: sudo apt-get install chromium-headless-shell")
    data_port, page_port = ports
    token = KEY.issue(
        "phone", now=time.time(), token_id="t", settings=PlatformSettings().auth,
        scopes=("maps:localise/rooms",),
    )  # fmt: skip
    asked: set[str] = set()
    wrong: list[str] = []
    with sync_api.sync_playwright() as playwright:
        fake = ["--use-fake-ui-for-media-stream", "--use-fake-device-for-media-stream"]
        film = f"--use-file-for-fake-video-capture={tmp_path / 'film.mjpeg'}"
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox", *fake, film])
        window = browser.new_page()
        window.on("pageerror", lambda error: wrong.append(str(error)))
        window.on("request", lambda request: asked.add(urlsplit(request.url).netloc))
        window.goto(f"http://localhost:{page_port}/place#map=rooms&url=http://127.0.0.1:{data_port}")
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
        browser.close()

    assert wrong == []
    assert said.startswith("ok ")
    place = np.array(found["T_map_camera"])[:3, 3]
    assert np.linalg.norm(places - place, axis=1).min() < 0.05
    np.testing.assert_allclose(red, [0xDD, 0x33, 0x33], atol=2)  # the canvas rounds
    assert asked == {f"localhost:{page_port}", f"127.0.0.1:{data_port}"}
