"""The verb map from-camera: a video becomes a map, and wrong calls get one line."""

from __future__ import annotations

import asyncio
import contextlib
import csv
import json
from collections.abc import AsyncIterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import client_sdk
from client_sdk.commands.answer_types import PoseAnswer
from client_sdk.mapper import Mapper
from client_sdk.point_map import read_ply
from client_sdk.pose_answers import ask_robot
from client_sdk.rigs.intrinsics import Intrinsics, write_intrinsics
from client_sdk.trajectory import Trajectory, read_trajectory, write_trajectory
from rse_pf.cli.main import main
from rse_pf.cli.maps import from_camera
from rse_pf.command_line.extras import is_installed
from rse_pf.pnp import refine_with_depth, solve_pnp
from rse_pf.storage.object_store import DirectoryStore
from rse_pf.storage.quotas import set_own_quota
from tests.kit.flat_world import CAMERA, STEP_M, frame_at

cv2 = pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")
from tests.kit.tum_recording import write_tum  # noqa: E402

needs_check = pytest.mark.skipif(not is_installed("client_sdk.check"), reason="client_sdk.check was removed")


class SolvingRobot:
    """A connected robot whose platform answers in this process."""

    async def solve_pnp(
        self, points_world: Any, pixels: Any, camera: Any, options: Any, **more: Any
    ) -> PoseAnswer:
        solution = solve_pnp(points_world, pixels, camera, options)
        if more["depths_m"] is not None:
            solution = refine_with_depth(solution, points_world, pixels, more["depths_m"], camera)
        return PoseAnswer(
            solution=solution, source="cloud", server="s", round_trip_ms=2.0, queue_ms=0.0, compute_ms=1.0
        )

    def mapper(self, **options: Any) -> Mapper:
        return Mapper(ask=ask_robot(self.solve_pnp), **options)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with a video, intrinsics, a token, and a platform that answers at ws://p/ws."""

    @contextlib.asynccontextmanager
    async def connect(urls: list[str], **options: Any) -> AsyncIterator[SolvingRobot]:
        assert (urls[-1], options["token"]) == ("ws://p/ws", "secret")
        Path("addresses").write_text(" ".join(urls))
        yield SolvingRobot()

    monkeypatch.setattr(client_sdk, "connect", connect, raising=False)
    monkeypatch.chdir(tmp_path)
    writer = cv2.VideoWriter("v.avi", cv2.VideoWriter_fourcc(*"FFV1"), 10.0, (320, 240))
    for row in range(9):
        writer.write(np.ascontiguousarray(frame_at(row, depth=False).rgb[:, :, ::-1]))
    writer.release()
    write_intrinsics("i.json", Intrinsics(camera=CAMERA))
    Path("token").write_text("secret\n")
    return tmp_path


PLATFORM = ("--url", "ws://p/ws", "--token-file", "token")


def test_a_video_becomes_a_map_in_metres_by_odometry(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = np.tile(np.eye(4), (60, 1, 1))
    poses[:, 0, 3] = 5 * STEP_M * np.arange(60)  # one metre is seven of the frames
    write_trajectory(Path("odometry.txt"), Trajectory(np.arange(60) / 10, poses))

    code = main(
        [
            "map",
            "from-camera",
            "v.avi",
            "--intrinsics",
            "i.json",
            "--scale",
            "odometry:odometry.txt",
            *PLATFORM,
        ]
    )

    report = json.loads(Path("out-camera/report.json").read_text())
    out = capsys.readouterr().out
    assert code == 0, out
    assert report["scale"] == "metric, by the first 1 m of odometry"
    assert read_trajectory(Path("out-camera/trajectory.txt")).length_m == pytest.approx(
        8 * 5 * STEP_M, rel=0.05
    )
    assert len(read_ply(Path("out-camera/map.ply"))[0]) > 300
    assert Path("out-camera/map.png").stat().st_size > 1000
    assert "9 frames, 0 lost" in out


@pytest.mark.parametrize("off_m", [0.0, 0.05])
def test_a_recording_with_true_poses_tells_the_error_of_the_path(
    folder: Path, capsys: pytest.CaptureFixture[str], off_m: float
) -> None:
    poses = np.tile(np.eye(4), (9, 1, 1))
    poses[:, 0, 3] = STEP_M * np.arange(9)
    poses[::2, 2, 3] = off_m
    frames = [frame_at(row, depth=True) for row in range(9)]
    write_tum(folder / "drive", frames, Trajectory(np.array([f.timestamp_s for f in frames]), poses))

    code = main(["map", "from-camera", "drive", *PLATFORM])

    out = capsys.readouterr().out
    report = json.loads(Path("out-camera/report.json").read_text())
    assert code == 0, out
    assert report["truth"] == "ground truth"
    assert report["ate_cm"] == pytest.approx(100 * off_m / 2, abs=0.3)
    assert f"error beside the ground truth: ATE {report['ate_cm']:.2f} cm" in out


@needs_check
def test_a_source_that_fails_keeps_what_was_mapped(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = Trajectory(np.arange(6) * 0.1, np.tile(np.eye(4), (6, 1, 1)))
    write_tum(folder / "drive", [frame_at(row, depth=True) for row in range(6)], truth)
    cv2.imwrite("drive/rgb/004.png", np.zeros((24, 32, 3), np.uint8))

    code = main(["map", "from-camera", "drive", *PLATFORM, "--out", "out"])

    shown = capsys.readouterr()
    assert code == 1
    assert "finding ended-early: the source failed after 4 frames, which are kept" in shown.out
    assert "is 32x24 px, the camera of the recording 320x240 px" in shown.err
    assert len(read_trajectory(folder / "out/trajectory.txt")) == 4


def test_a_map_above_the_quota_of_its_tenant_is_not_kept_and_the_drive_is(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = Trajectory(np.arange(6) * 0.1, np.tile(np.eye(4), (6, 1, 1)))
    write_tum(folder / "drive", [frame_at(row, depth=True) for row in range(6)], truth)
    Path("objects").mkdir()
    set_own_quota(DirectoryStore(Path("objects")), "acme", 1000)

    main(["map", "from-camera", "drive", *PLATFORM, "--objects", "objects", "--tenant", "acme"])

    assert "and not in a store: quota: the tenant 'acme' stores 0 bytes" in capsys.readouterr().out
    assert not list(Path("objects").glob("maps/acme/*"))
    assert len(read_ply(Path("out-camera/map.ply"))[0]) > 100


RNG = np.random.default_rng(3)


@needs_check
@pytest.mark.parametrize(
    ("seen", "hint"),
    [
        (lambda image: RNG.normal(170, 2, image.shape), "show no texture: point the camera at things with"),
        (lambda image: np.full_like(image, 255), "show no texture"),
        (lambda image: 0.04 * image, "are dark: add light"),
        (lambda image: RNG.normal(6, 2, image.shape), "are dark: add light"),
        (lambda image: cv2.blur(np.kron(RNG.integers(0, 256, (8, 10, 3)), np.ones((30, 32, 1))), (25, 25)),
         "are blurred: drive more slowly"),
        (lambda image: image[RNG.permutation(240)], "compare the intrinsics"),
    ],
)  # fmt: skip
def test_the_hint_of_a_lost_drive_names_what_its_images_show(
    folder: Path, seen: Any, hint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = [frame_at(row, depth=True) for row in range(12)]
    lost = [replace(frame, rgb=np.clip(seen(frame.rgb), 0, 255).astype(np.uint8)) for frame in frames]
    write_tum(folder / "drive", lost, Trajectory(np.arange(12) / 10, np.tile(np.eye(4), (12, 1, 1))))

    assert main(["map", "from-camera", "drive", *PLATFORM]) == 1

    assert hint in capsys.readouterr().err.splitlines()[-1]


def test_a_path_without_scale_has_no_error_in_centimetres(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = np.tile(np.eye(4), (9, 1, 1))
    poses[:, 0, 3] = STEP_M * np.arange(9)
    frames = [frame_at(row, depth=True) for row in range(9)]
    write_tum(folder / "drive", frames, Trajectory(np.array([f.timestamp_s for f in frames]), poses))

    code = main(["map", "from-camera", "drive", "--no-depth", *PLATFORM])

    out = capsys.readouterr().out
    report = json.loads(Path("out-camera/report.json").read_text())
    assert code == 0, out
    assert report["unit"] != "m"
    assert [report[name] for name in ("path_m", "ate_cm", "rpe_cm")] == [None, None, None]
    assert "error beside" not in out


def test_several_addresses_are_given_to_the_robot_which_takes_the_nearest(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["v.avi", "--intrinsics", "i.json", "--frames", "7", "--url", "ws://q/ws", *PLATFORM]

    assert main(["map", "from-camera", *words]) == 0, capsys.readouterr().out

    assert Path("addresses").read_text() == "ws://q/ws ws://p/ws"


def test_without_a_scale_the_command_says_so(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["map", "from-camera", "v.avi", "--intrinsics", "i.json", "--frames", "7", *PLATFORM])

    out = capsys.readouterr().out
    assert code == 0
    assert "units; scale: up to scale" in out
    assert json.loads(Path("out-camera/report.json").read_text())["scale"] == "up to scale"
    assert "metres" not in Path("out-camera/trajectory.txt").read_text()
    assert b"comment up to scale" in Path("out-camera/map.ply").read_bytes()[:200]
    assert len(read_ply(Path("out-camera/map.ply"))[0]) > 100


def test_each_frame_has_a_row_that_says_why_it_has_no_pose(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    writer = cv2.VideoWriter("dark.avi", cv2.VideoWriter_fourcc(*"FFV1"), 10.0, (320, 240))
    for row in range(9):
        image = frame_at(row, depth=False).rgb[:, :, ::-1]
        writer.write(np.ascontiguousarray(image if row != 7 else 0 * image))
    writer.release()

    code = main(["map", "from-camera", "dark.avi", "--intrinsics", "i.json", *PLATFORM])

    rows = list(csv.DictReader(Path("out-camera/frames.csv").read_text().splitlines()))
    assert code == 0
    assert [row["frame"] for row in rows] == [str(number) for number in range(1, 10)]
    assert (rows[7]["status"], rows[7]["verdict"]) == ("lost", "none")
    assert rows[8]["verdict"] == "ok"
    assert float(rows[8]["sigma_position"]) > 0
    assert f"lost: frame 8; because: {rows[7]['reason']}" in capsys.readouterr().out


def test_a_pipe_gets_a_line_of_progress_every_five_seconds(
    capsys: pytest.CaptureFixture[str],
) -> None:
    status = from_camera._Status(now=iter([0.0, 4.9, 5.0, 5.0, 9.9, 10.0, 10.0]).__next__)
    mapper = Mapper(ask=ask_robot(SolvingRobot().solve_pnp))
    done = asyncio.run(mapper.track(frame_at(0, depth=True)))

    for _ in range(4):
        status.show(mapper, done)
    status.end()

    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert lines[0].startswith("frame 1: first, ")


def test_a_camera_that_does_not_move_is_no_map(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    writer = cv2.VideoWriter("still.avi", cv2.VideoWriter_fourcc(*"FFV1"), 10.0, (320, 240))
    for _ in range(3):
        writer.write(frame_at(0, depth=False).rgb)
    writer.release()

    code = main(["map", "from-camera", "still.avi", "--intrinsics", "i.json", *PLATFORM])

    error = capsys.readouterr().err
    assert code == 1
    assert "3 of 3 frames have no pose in the map" in error
    assert "must move, not only turn" in error


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["v.avi"], "the intrinsics of v.avi are not known"),
        (["none.avi", "--intrinsics", "i.json"], "none.avi does not exist"),
        (["none"], "none does not exist"),
        (["none.bag"], "none.bag does not exist"),
        (["none/of/these"], "none/of/these does not exist: there is no folder none"),
        (["v.avi,none.avi"], "none.avi does not exist"),
        (["77", "--intrinsics", "i.json"], "camera 77 cannot be opened: /dev/video77 does not exist"),
        (["/dev/null", "--intrinsics", "i.json"], "there is no video /dev/null: it is no regular file"),
        (["v.avi", "--intrinsics", "none.json"], "there is no none.json"),
        (["v.avi", "--intrinsics", "i.json", "--scale", "marker:big"], "--scale marker:big is unknown"),
        (["v.avi", "--intrinsics", "i.json", "--scale", "marker:99999"], "not within 5..5000 mm"),
        (["v.avi", "--intrinsics", "i.json", "--scale", "odometry:none.txt"], "cannot read none.txt"),
        (["v.avi", "--intrinsics", "i.json", "--rate", "0"], "rate 0 is not a finite number above 0"),
        (["v.avi", "--intrinsics", "i.json", "--frames", "1"], "--frames 1 is below 2"),
        (["v.avi", "--intrinsics", "i.json", "--url", "ws://p/ws"], "need each other"),
        (["v.avi", "--url", "p", "--token-file", "token"], "is not a WebSocket address"),
        (["v.avi", "--url", "q", *PLATFORM], "'q' is not a WebSocket address"),
        (["v.avi", "--enrolment", "e", *PLATFORM], "--enrolment names address and key"),
        (["v.avi", "--intrinsics", "i.json", "--out", "v.avi", *PLATFORM], "cannot make v.avi"),
        (
            ["v.avi", "--intrinsics", "i.json", "--url", "ws://p/ws", "--token-file", "no"],
            "cannot read the token in no",
        ),
    ],
)
def test_a_wrong_call_gets_one_line_and_a_hint(
    words: list[str], sentence: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["map", "from-camera", *words]) == 2

    lines = capsys.readouterr().err.splitlines()
    assert sentence in lines[0]
    assert lines[1].startswith("  hint: ")


@pytest.mark.slow
@pytest.mark.system
def test_a_video_becomes_a_map_through_a_platform_of_its_own(tmp_path: Path, recordings: Path) -> None:
    kitchen = recordings / "7scenes_redkitchen"

    code = main(
        ["map", "from-camera", str(kitchen), "--no-depth", "--frames", "40", "--out", str(tmp_path / "out"),
         "--scale", f"odometry:{kitchen / 'groundtruth.txt'}"]
    )  # fmt: skip

    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert code == 0
    assert report["lost_frames"] == 0
    assert set(report["answered_by"]) == {"cloud"}
