"""Every example, run as its page says, on one platform: programs as processes, notebooks cell by cell."""

from __future__ import annotations

import ast
import asyncio
import inspect
import json
import os
import re
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from client_sdk.datasets import open_dataset
from client_sdk.point_map import read_ply
from client_sdk.trajectory import read_trajectory
from tests.examples.conftest import ExamplePlatform, Program
from tests.kit.delaying_proxy import DelayingProxy
from tests.kit.example_page import REPOSITORY

cv2 = pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")
from tests.examples.test_object_recognition import COVER, placed  # noqa: E402  after importorskip
from tests.kit.rendered_inputs import SCENE_CAMERA, draw_scene, write_video  # noqa: E402  after importorskip

pytestmark = pytest.mark.system
Start = Callable[[list[str]], Program]


@pytest.fixture(scope="module", autouse=True)
def long_run(platform: ExamplePlatform) -> Iterator[Program]:
    """A robot whose tokens live 10 s, beside all other tests; its end is tested last."""
    command = platform.command("own_key_for_days", "--token-life", "10", "--every", "1")
    program = platform.start([word.replace("127.0.0.1:8700", _address(platform)) for word in command])
    yield program
    program.end()


def _address(platform: ExamplePlatform) -> str:
    return f"127.0.0.1:{platform.cloud.port}"


def test_ten_lines_print_a_pose(platform: ExamplePlatform) -> None:
    done = platform.run(platform.command("ten_lines"))

    assert (done.returncode, done.stderr) == (0, "")
    assert re.match(r"ok: \d+ inliers, by server-1\n\[\[", done.stdout)


def test_a_wrong_file_is_reported_without_a_traceback(platform: ExamplePlatform) -> None:
    done = platform.run(platform.command("ten_lines", **{"robot-1.enrolment": "none.enrolment"}))

    assert done.returncode == 1
    assert done.stderr.splitlines()[0].startswith("cannot read the enrolment none.enrolment")
    assert done.stderr.splitlines()[1].startswith("  hint: make one with rse-pf robot enrol")
    assert "Traceback" not in done.stderr


@pytest.mark.slow
def test_a_video_becomes_a_map(platform: ExamplePlatform) -> None:
    write_video(platform.folder / "drive.mp4", frames=20)

    done = platform.run(platform.command("live_camera"))

    assert (done.returncode, done.stderr) == (0, "")
    assert "20 frames, 0 lost; scale: up to scale" in done.stdout
    assert len(read_ply(platform.folder / "out-camera" / "map.ply")[0]) > 100
    along = read_trajectory(platform.folder / "out-camera" / "trajectory.txt").positions
    steps = np.arange(20)[:, None] / 19 * along[-1]
    assert np.linalg.norm(along - steps, axis=1).max() < 0.1 * np.linalg.norm(along[-1])


def test_rendered_images_become_a_bag(platform: ExamplePlatform) -> None:
    pytest.importorskip("rosbags", reason="pip install 'rse-pf[bags]'")

    done = platform.run(platform.command("make_bag", "--frames", "3"))

    assert (done.returncode, done.stderr) == (0, "")
    assert [frame.rgb.shape for frame in open_dataset(platform.folder / "kitchen.bag")] == [(480, 640, 3)] * 3


def test_a_control_loop_gets_poses(platform: ExamplePlatform) -> None:
    done = platform.run(platform.command("blocking_loop", "--turns", "10"))

    assert (done.returncode, done.stderr) == (0, "")
    assert "m, " in done.stdout
    assert re.search(r"10 turns, [0-9] without a pose", done.stdout), done.stdout


def test_a_robot_goes_on_when_the_cloud_is_gone_and_uses_it_again(
    platform: ExamplePlatform, relay: DelayingProxy, start: Start
) -> None:
    file = platform.enrolment_at(relay.url, "relay.enrolment")
    program = start(platform.command("without_cloud", "--rate", "20", **{"robot-1.enrolment": file}))
    program.until("pose by the cloud")

    platform.wait(relay.die())
    program.until("pose by the robot (no connection to the cloud)")
    platform.wait(relay.listen())
    program.until("pose by the cloud")

    assert program.interrupt() == 0
    assert "Traceback" not in program.said


def test_a_robot_starts_without_a_cloud(platform: ExamplePlatform, start: Start) -> None:
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        file = platform.enrolment_at(f"ws://127.0.0.1:{held.getsockname()[1]}/ws", "nobody.enrolment")
        program = start(platform.command("without_cloud", **{"robot-1.enrolment": file}))

        program.until("pose by the robot (no connection to the cloud)")

        assert program.interrupt() == 0


def test_a_photo_shows_an_object_and_a_tag(platform: ExamplePlatform) -> None:
    cover, tag = placed(0)
    cv2.imwrite(str(platform.folder / "photo.png"), draw_scene(COVER, cover, tag, tag=3, seed=0))
    camera = {each: getattr(SCENE_CAMERA, each) for each in ("fx", "fy", "cx", "cy", "width", "height")}
    (platform.folder / "photo.json").write_text(json.dumps(camera))

    done = platform.run(platform.command("recognise_objects", "--intrinsics", "photo.json"))

    assert (done.returncode, done.stderr) == (0, "")
    found = dict(re.findall(r"^(\S+) at (\S+ \S+ \S+) m", done.stdout, re.MULTILINE))
    assert found.keys() == {"cover", "tag36h11:3"}
    for name, pose, within_m in (("cover", cover, 0.002), ("tag36h11:3", tag, 0.02)):
        assert np.array(found[name].split(), float) == pytest.approx(pose[:3, 3], abs=within_m)


def run_notebook(path: Path) -> dict[str, Any]:
    """Run the cells of a notebook in order, in one namespace with a running event loop, as Jupyter does."""
    names: dict[str, Any] = {}

    async def run() -> None:
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
            if cell["cell_type"] == "code":
                flags = ast.PyCF_ALLOW_TOP_LEVEL_AWAIT
                code = compile("".join(cell["source"]), f"{path.name}:{cell['id']}", "exec", flags)
                result = eval(code, names)
                if inspect.isawaitable(result):
                    await result

    asyncio.run(run())
    return names


@pytest.fixture
def in_folder(platform: ExamplePlatform, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the platform, as the current one."""
    monkeypatch.chdir(platform.folder)
    return platform.folder


NOTEBOOKS = REPOSITORY / "examples" / "notebooks"


@pytest.mark.slow
def test_the_notebook_makes_a_map_from_frames(in_folder: Path) -> None:
    names = run_notebook(NOTEBOOKS / "camera_to_map.ipynb")

    assert [done.lost for done in names["tracked"]] == [False] * 12
    assert names["error_m"].max() < 0.05
    assert os.path.getsize(in_folder / "out-notebook" / "map.png") > 10_000


def test_the_notebook_explains_bad_poses(in_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = run_notebook(NOTEBOOKS / "bad_pose.ipynb")

    expected = {"good": "ok", "few": "weak", "clustered": "ok", "tiny": None, "line": None, "noise": None}
    assert {name: names[name] and names[name].verdict for name in expected} == expected
    assert names["spread_m"][2] > 5 * names["spread_m"][1]
    said = capsys.readouterr().out
    assert "no pose: degenerate" in said
    assert "no pose: no-consensus" in said


def test_a_robot_with_its_own_key_outlives_its_tokens(long_run: Program) -> None:
    long_run.until("signed a token")
    long_run.until("signed a token")  # the first one would have expired
    for _ in range(6):
        line = long_run.until("pose ")

    assert ", 0 reconnects" in line
    assert long_run.interrupt() == 0
    assert "Traceback" not in long_run.said
