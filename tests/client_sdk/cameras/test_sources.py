"""One contract for every source of frames, and one clear line for sources that cannot be used."""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from client_sdk.cameras import FrameSource, Intrinsics, open_camera, read_intrinsics, write_intrinsics
from client_sdk.cameras.opencv_video import open_video
from rse_pf.errors import MissingExtra, RsePfError, UsageError
from rse_pf.geometry import Camera

cv2 = pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

CAMERA = Camera(fx=60.0, fy=60.0, cx=31.5, cy=23.5, width=64, height=48)
INTRINSICS = Intrinsics(camera=CAMERA, depth_scale=1000.0)
FRAMES = 5


def picture(row: int) -> npt.NDArray[np.uint8]:
    image = np.zeros((48, 64, 3), np.uint8)
    image[:, :, 2] = 200  # BGR: a red picture
    image[:, : 10 * row] = 255
    return image


def video(folder: Path) -> Path:
    writer = cv2.VideoWriter(str(folder / "v.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (64, 48))
    for row in range(FRAMES):
        writer.write(picture(row))
    writer.release()
    return folder / "v.avi"


def images(folder: Path, *, depth: bool) -> Path:
    for name in ("rgb", "depth") if depth else ("rgb",):
        (folder / name).mkdir()
    for row in range(FRAMES):
        cv2.imwrite(str(folder / "rgb" / f"{row}.png"), picture(row))
        if depth:
            cv2.imwrite(str(folder / "depth" / f"{row}.png"), np.full((48, 64), 1500, np.uint16))
    write_intrinsics(folder / "intrinsics.json", INTRINSICS)
    return folder


def recording(folder: Path) -> Path:
    images(folder, depth=True)
    for name in ("rgb", "depth"):
        lines = [f"{row / 10:.1f} {name}/{row}.png" for row in range(FRAMES)]
        (folder / f"{name}.txt").write_text("\n".join(lines))
    return folder


class FakeDevice:
    """A camera that OpenCV has opened."""

    def __init__(self, source: int) -> None:
        self.left, self.released = FRAMES, False

    def isOpened(self) -> bool:
        return True

    def set(self, what: int, value: float) -> None: ...

    def get(self, what: int) -> float:
        return 30.0

    def read(self) -> tuple[bool, Any]:
        self.left -= 1
        return self.left >= 0, picture(FRAMES - self.left)

    def release(self) -> None:
        self.released = True


def fake_realsense() -> SimpleNamespace:
    """A stand-in of pyrealsense2 with one camera that gives FRAMES frames."""
    lens = SimpleNamespace(
        fx=60.0, fy=60.0, ppx=31.5, ppy=23.5, width=64, height=48, model="none", coeffs=[0.0] * 5
    )
    left = iter(range(FRAMES))

    def frames(timeout_ms: int) -> Any:
        row = next(left, None)
        if row is None:
            raise RuntimeError("Frame didn't arrive")
        rgb, z16 = picture(row)[:, :, ::-1], np.full((48, 64), 1500, np.uint16)
        colour = SimpleNamespace(get_data=lambda: rgb, get_timestamp=lambda: 1e3 + 100.0 * row)
        return SimpleNamespace(
            get_color_frame=lambda: colour, get_depth_frame=lambda: SimpleNamespace(get_data=lambda: z16)
        )

    device = SimpleNamespace(
        first_depth_sensor=lambda: SimpleNamespace(get_depth_scale=lambda: 0.001),
    )
    stream = SimpleNamespace(as_video_stream_profile=lambda: SimpleNamespace(get_intrinsics=lambda: lens))
    profile = SimpleNamespace(get_device=lambda: device, get_stream=lambda which: stream)
    pipeline = SimpleNamespace(start=lambda config: profile, wait_for_frames=frames, stop=lambda: None)
    config = SimpleNamespace(enable_stream=lambda *a: None)
    return SimpleNamespace(
        config=lambda: config, pipeline=lambda: pipeline, stream=SimpleNamespace(color=1, depth=2),
        format=SimpleNamespace(rgb8=1, z16=2), distortion=SimpleNamespace(brown_conrady="brown"),
        align=lambda to: SimpleNamespace(process=lambda each: each),
    )  # fmt: skip


def opened(kind: str, folder: Path, patch: pytest.MonkeyPatch) -> tuple[FrameSource, bool]:
    """Return a source of five frames, and whether it has depth."""
    if kind == "video":
        return open_camera(video(folder), intrinsics=INTRINSICS), False
    if kind in ("images", "images with depth"):
        depth = kind == "images with depth"
        return open_camera(images(folder, depth=depth)), depth
    if kind == "recording":
        return open_camera(str(recording(folder))), True
    if kind == "device":
        patch.setattr(cv2, "VideoCapture", FakeDevice)
        return open_camera(0, intrinsics=INTRINSICS), False
    patch.setitem(sys.modules, "pyrealsense2", fake_realsense())
    return open_camera("realsense"), True


KINDS = ("video", "images", "images with depth", "recording", "device", "realsense")


@pytest.mark.parametrize("kind", KINDS)
def test_every_source_keeps_the_contract(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source, depth = opened(kind, tmp_path, monkeypatch)

    assert isinstance(source, FrameSource)
    assert iter(source) is source
    frames = list(itertools.islice(source, FRAMES))
    assert len(frames) == FRAMES
    assert (source.camera, source.has_depth) == (CAMERA, depth)
    stamps = [frame.timestamp_s for frame in frames]
    assert all(earlier < later for earlier, later in itertools.pairwise(stamps))
    for frame in frames:
        assert frame.camera == CAMERA
        assert (frame.rgb.dtype, frame.depth_m.dtype) == (np.uint8, np.float32)
        assert bool(frame.depth_m.any()) == depth
    assert frames[0].rgb[24, 60].astype(int) == pytest.approx([200, 0, 0], abs=25)  # red first
    if depth:
        assert frames[0].depth_m[24, 32] == pytest.approx(1.5)
    source.close()
    source.close()
    assert next(source, None) is None


def test_a_rate_leaves_frames_out(tmp_path: Path) -> None:
    with open_camera(video(tmp_path), intrinsics=INTRINSICS, rate_hz=5.0) as source:
        assert [frame.timestamp_s for frame in source] == pytest.approx([0.0, 0.2, 0.4])


def test_depth_can_be_left_out(tmp_path: Path) -> None:
    with open_camera(recording(tmp_path), depth=False) as source:
        assert not next(source).depth_m.any()
        assert not source.has_depth


@pytest.mark.parametrize("name", ["realsense", "00"])
def test_a_folder_with_the_name_of_a_device_is_the_folder(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / name).mkdir()
    images(tmp_path / name, depth=False)
    monkeypatch.chdir(tmp_path)

    with open_camera(name) as source:
        assert len(list(source)) == FRAMES


def test_a_device_that_ends_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "VideoCapture", FakeDevice)
    ticks = itertools.count()

    video = open_video("0", clock=lambda: float(next(ticks)))

    assert [stamp for stamp, _, _ in itertools.islice(video.images, FRAMES)] == [0.0, 1.0, 2.0, 3.0, 4.0]
    with pytest.raises(UsageError, match="no more images"):
        next(video.images)
    video.close()


@pytest.mark.parametrize("place", ["cv2", "cv2.utils.logging"])
def test_opencv_is_silenced_where_its_version_has_the_function(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    levels: list[int] = []
    holder = SimpleNamespace(setLogLevel=levels.append)
    if place == "cv2":
        monkeypatch.setattr(cv2, "setLogLevel", levels.append, raising=False)
    else:  # 4.14
        monkeypatch.delattr(cv2, "setLogLevel", raising=False)
        monkeypatch.setattr(cv2.utils, "logging", holder, raising=False)

    with open_camera(video(tmp_path), intrinsics=INTRINSICS) as source:
        assert len(list(source)) == FRAMES
    assert levels == [0]


def test_a_distorted_lens_is_straightened(tmp_path: Path) -> None:
    bent = Intrinsics(camera=CAMERA, distortion=(-0.4, 0.1, 0.0, 0.0, 0.0))
    path = video(tmp_path)

    *_, straight = open_camera(path, intrinsics=bent)
    *_, plain = open_camera(path, intrinsics=INTRINSICS)

    assert not np.array_equal(straight.rgb, plain.rgb)


def test_intrinsics_are_read_as_they_were_written(tmp_path: Path) -> None:
    made = Intrinsics(
        camera=CAMERA, distortion=(0.1, 0.0, 0.0, 0.0, 0.2), depth_scale=5000.0, rms_px=0.25, views=20
    )

    write_intrinsics(tmp_path / "i.json", made)

    assert read_intrinsics(tmp_path / "i.json") == made


def _of_another_size(folder: Path) -> None:
    camera = Camera(fx=60.0, fy=60.0, cx=40.0, cy=30.0, width=80, height=60)
    list(open_camera(video(folder), intrinsics=Intrinsics(camera=camera)))


def _without_depth_of_the_same_number(folder: Path) -> None:
    for path in (images(folder, depth=True) / "depth").iterdir():
        path.rename(path.with_name(f"{int(path.stem) + 100}.png"))
    open_camera(folder)


def _with_depth_of_8_bits(folder: Path) -> None:
    cv2.imwrite(str(images(folder, depth=True) / "depth" / "0.png"), np.zeros((48, 64), np.uint8))
    next(open_camera(folder))


def _with_broken_images(folder: Path) -> None:
    for path in (images(folder, depth=False) / "rgb").iterdir():
        path.write_bytes(b"no image")
    open_camera(folder)


def _without_intrinsics(folder: Path) -> None:
    (images(folder, depth=False) / "intrinsics.json").unlink()
    open_camera(folder)


def _with_wrong_intrinsics(folder: Path) -> None:
    (folder / "i.json").write_text(json.dumps({"fx": 1}))
    open_camera(video(folder), intrinsics=folder / "i.json")


def _of_no_video(folder: Path) -> None:
    (folder / "x.mp4").write_bytes(b"no video")
    open_camera(folder / "x.mp4", intrinsics=INTRINSICS)


def _of_an_empty_folder(folder: Path) -> None:
    write_intrinsics(folder / "intrinsics.json", INTRINSICS)
    open_camera(folder)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (_of_another_size, "gives images of 64x48 px, its intrinsics are for 80x60 px"),
        (_without_depth_of_the_same_number, "none of 5 images of .* has a depth image"),
        (_with_depth_of_8_bits, "not a 16-bit depth image"),
        (_with_broken_images, "cannot read the image"),
        (_without_intrinsics, "there is no .*intrinsics.json"),
        (_with_wrong_intrinsics, "has no fy"),
        (_of_no_video, "is a text file, not a video"),
        (_of_an_empty_folder, "holds no image"),
        (lambda folder: open_camera(folder / "none.mp4", intrinsics=INTRINSICS), "none.mp4 does not exist"),
        (lambda folder: open_camera(folder / "none.mp4"), "none.mp4 does not exist"),
        (lambda folder: open_camera(99, intrinsics=INTRINSICS), "camera 99 cannot be opened"),
        (lambda folder: open_camera(0), "intrinsics of 0 are not known"),
        (lambda folder: open_camera("0,2"), "0,2 names two cameras, and no rig"),
        (lambda folder: open_camera("0,2", intrinsics=INTRINSICS), "0,2 names two cameras, and no rig"),
        (lambda folder: open_camera("x.mcap"), "x.mcap does not exist"),
        (lambda folder: open_camera(video(folder), intrinsics=INTRINSICS, rate_hz=0.0), "rate 0"),
    ],
)
def test_a_source_that_cannot_be_used_is_refused_in_one_line(
    make: Callable[[Path], None], sentence: str, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match=sentence) as refused:
        make(tmp_path)

    assert refused.value.hint
    assert "\n" not in refused.value.message


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)

    with pytest.raises(MissingExtra) as missing:
        open_camera("realsense")

    assert isinstance(missing.value, RsePfError)
    assert "rse-pf[realsense]" in missing.value.hint
