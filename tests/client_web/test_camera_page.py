"""The example page in Chromium: a film of AprilTags is its camera, and its poses are compared with the truth.

Frame i of the film shows the tag i at a pose of its own, so every answer names the frame that it belongs to.
"""

from __future__ import annotations

import contextlib
import json
import re
import shutil
import socket
import statistics
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rse_pf.geometry import Array, exp_se3, pose_difference
from tests.examples.conftest import ExamplePlatform, Program
from tests.examples.conftest import platform as platform
from tests.kit.chromium import chromium, film_as_camera

cv2 = pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")
from tests.examples.test_object_recognition import COVER  # noqa: E402
from tests.kit.rendered_inputs import SCENE_CAMERA, TAG_M, draw_scene  # noqa: E402

pytestmark = [pytest.mark.slow, pytest.mark.system, pytest.mark.timeout(300)]

REPOSITORY = Path(__file__).resolve().parents[2]
FRAMES = 12
ANSWERS = 8
HOLD = 10
"""Number of successive frames of the film that show the same tag: a camera of 10 frames a second."""
with socket.create_server(("127.0.0.1", 0)) as _free:
    PORT = _free.getsockname()[1]
ALLOWED_ORIGINS = f"http://localhost:{PORT}"


def tag_pose(frame: int) -> Array:
    """Return the pose of the tag of a frame: tilted, and at 0.5 to 0.8 m."""
    rng = np.random.default_rng(frame)
    pose = exp_se3(np.concatenate([[0.0, 0.0, 0.0], rng.uniform(0.2, 0.4, 3) * rng.choice([-1, 1], 3)]))
    pose[:3, 3] = [rng.uniform(-0.05, 0.15), rng.uniform(-0.1, 0.1), rng.uniform(0.5, 0.8)]
    return pose


def write_film(path: Path) -> None:
    """Write the film as Motion-JPEG, which Chromium reads in the place of a camera."""
    far = np.eye(4)
    far[:3, 3] = [-5.0, 0.0, 1.0]  # the cover is out of sight
    with path.open("wb") as film:
        for frame in range(FRAMES):
            photo = draw_scene(COVER, far, tag_pose(frame), tag=frame, seed=frame)
            jpeg = cv2.imencode(".jpg", photo, (cv2.IMWRITE_JPEG_QUALITY, 95))[1].tobytes()
            film.write(jpeg * HOLD)


@pytest.fixture
def page(platform: ExamplePlatform) -> Iterator[str]:
    """The address of the example's page, served as its text says."""
    words = [sys.executable, str(REPOSITORY / "examples" / "web" / "serve.py"), "--port", str(PORT)]
    program = Program(subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True))
    found = re.search(r"http://\S+", program.until("http"))
    assert found is not None
    yield found[0].replace("127.0.0.1", "localhost")
    program.end()


def test_the_first_pose_in_a_page_is_shown(platform: ExamplePlatform, tmp_path: Path) -> None:
    text = (REPOSITORY / "docs" / "howto" / "browser_robot.md").read_text(encoding="utf-8")
    found = re.search(r"```text\n(<!doctype html>.*?)```", text, re.DOTALL)
    assert found is not None
    (tmp_path / "pose.html").write_text(
        found[1].replace("127.0.0.1:8700", f"127.0.0.1:{platform.cloud.port}")
    )
    shutil.copy(REPOSITORY / "client_web" / "rse-pf.js", tmp_path)
    token = platform.cloud.issue_token("first-page", None)
    server = subprocess.Popen(
        [sys.executable, "-m", "http.server", str(PORT), "--bind", "127.0.0.1"],
        cwd=tmp_path, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
    )  # fmt: skip

    try:
        with chromium() as browser:
            page = browser.new_page()
            for _ in range(100):  # until the server of the page answers
                with contextlib.suppress(pytest.importorskip("playwright.sync_api").Error):
                    page.goto(f"http://localhost:{PORT}/pose.html#{token}")
                    break
                page.wait_for_timeout(100)
            page.wait_for_function("document.querySelector('pre').textContent !== ''", timeout=60_000)
            shown = page.inner_text("pre")
    finally:
        server.kill()
        server.wait()

    assert shown.startswith(("ok by server-1", "weak by server-1")), shown


def test_the_page_draws_the_poses_of_its_camera(platform: ExamplePlatform, page: str) -> None:
    film = platform.folder / "film.mjpeg"
    write_film(film)
    token = platform.cloud.issue_token("phone", None)
    hash_ = f"url=ws://localhost:{platform.cloud.port}/ws&tag={TAG_M}&focal={SCENE_CAMERA.fx}"
    seen: dict[str, Any] = {}
    wrong: list[str] = []

    with chromium(*film_as_camera(film)) as browser:
        window = browser.new_page()
        window.on("pageerror", lambda error: wrong.append(str(error)))
        window.goto(f"{page}#{hash_}")
        window.fill("#token", token)
        window.click("button")
        while len(seen) < ANSWERS:
            window.wait_for_function(
                "(seen) => { const { found } = document.querySelector('pre').dataset;"
                " return found && JSON.parse(found).found.some((each) => !seen.includes(each.name)); }",
                arg=list(seen), timeout=60_000,
            )  # fmt: skip
            told = json.loads(window.evaluate("document.querySelector('pre').dataset.found"))
            seen |= {each["name"]: (each, told["figures"]) for each in told["found"]}
        picture = window.locator("canvas").screenshot()
        said = window.inner_text("output")

    assert wrong == []
    assert said == "connected to server-1 as phone"
    assert len(picture) > 10_000
    for name, (each, _) in seen.items():
        truth = tag_pose(int(name.removeprefix("tag36h11:")))
        metres, degrees = pose_difference(np.array(each["T_camera_object"]).reshape(4, 4), truth)
        assert metres <= 0.02, name
        assert degrees <= 4.0, name
    figures = [figures for _, figures in seen.values()]
    print({name: round(statistics.median(each[name] for each in figures), 1) for name in figures[0]})
