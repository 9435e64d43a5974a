"""Videos, images and recordings of strangers: bounded before they are decoded, and one line for each."""

from __future__ import annotations

import json
import os
import resource
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from client_sdk.cameras import open_camera, read_intrinsics
from client_sdk.datasets import associate_stamps, open_dataset
from client_sdk.rigs.intrinsics import Intrinsics
from rse_pf.errors import UsageError
from rse_pf.geometry import Camera

cv2 = pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

CAMERA = {"fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, "width": 64, "height": 48, "depth_scale": 1000}
MAX_GROWTH_BYTES = 300 << 20
"""Of a process that is shown a bomb, above what it takes with OpenCV loaded."""
SHOWN = """
import resource, sys
from pathlib import Path
from client_sdk.cameras import open_camera
from client_sdk.frontend import load_opencv
from rse_pf.errors import RsePfError
load_opencv()
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
intrinsics = sys.argv[2] if len(sys.argv) > 2 else None
try:
    with open_camera(sys.argv[1], intrinsics=intrinsics) as source:
        frames = sum(1 for _ in source)
except RsePfError as error:
    print(error.report())
else:
    print(frames, "frames")
print("grown", (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024)
"""


def shown(*arguments: Path) -> tuple[str, int]:
    """Show a source to a process of its own, as a robot does; return what it says, and by how much it grew.

    In a process that loaded OpenCV before us, our limit of images would not hold.
    """
    environment = {name: value for name, value in os.environ.items() if not name.startswith("OPENCV_")}
    done = subprocess.run(
        [sys.executable, "-c", SHOWN, *map(str, arguments)],
        env=environment, capture_output=True, text=True, timeout=60, check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_DATA, (6 << 30, 6 << 30)),
    )  # fmt: skip
    assert "Traceback" not in done.stderr, done.stderr
    *said, grown = done.stdout.strip().splitlines()
    return "\n".join(said), int(grown.split()[1])


def png(width: int, height: int) -> bytes:
    """Return a 16-bit PNG of zeros; of a hundred million pixels it has 200 kB."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packer = zlib.compressobj(9)
    row = bytes(1 + 2 * width)
    rows = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()
    head = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def video(size: tuple[int, int], frames: int, claimed: tuple[int, int]) -> bytes:
    """Return an AVI of JPEG images that says to be of another size, in its head and in each image."""
    image = cv2.imencode(".jpg", np.full((size[1], size[0], 3), 128, np.uint8))[1].tobytes()
    at = image.index(b"\xff\xc0") + 5
    image = image[:at] + struct.pack(">HH", claimed[1], claimed[0]) + image[at + 4 :]

    def chunk(name: bytes, data: bytes) -> bytes:
        return name + struct.pack("<I", len(data)) + data + bytes(len(data) % 2)

    main = struct.pack("<14I", 100000, 0, 0, 0x10, frames, 0, 1, 0, *claimed, 0, 0, 0, 0)
    stream = b"vidsMJPG" + struct.pack("<IHHIIIIIIIIhhhh", 0, 0, 0, 0, 1, 10, 0, frames, *[0] * 7)
    form = struct.pack("<IiiHH4sIiiII", 40, *claimed, 1, 24, b"MJPG", 0, 0, 0, 0, 0)
    streams = chunk(b"LIST", b"strl" + chunk(b"strh", stream) + chunk(b"strf", form))
    heads = chunk(b"LIST", b"hdrl" + chunk(b"avih", main) + streams)
    return chunk(b"RIFF", b"AVI " + heads + chunk(b"LIST", b"movi" + chunk(b"00dc", image) * frames))


def recording(folder: Path, **listed: str) -> Path:
    """Write a recording of one frame in TUM layout; *listed* replaces ``rgb.txt`` or ``depth.txt``."""
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    cv2.imwrite(str(folder / "rgb/1.png"), np.zeros((48, 64, 3), np.uint8))
    cv2.imwrite(str(folder / "depth/1.png"), np.full((48, 64), 1000, np.uint16))
    (folder / "intrinsics.json").write_text(json.dumps(CAMERA))
    for name in ("rgb", "depth"):
        (folder / f"{name}.txt").write_text(listed.get(name, f"1.0 {name}/1.png\n"))
    return folder


@pytest.fixture
def intrinsics(tmp_path: Path) -> Path:
    path = tmp_path / "intrinsics.json"
    path.write_text(json.dumps(CAMERA))
    return path


# --- videos -----------------------------------------------------------------------------------------------


def test_a_video_that_says_to_be_enormous_is_refused_before_it_is_decoded(tmp_path: Path, intrinsics: Path):
    (tmp_path / "v.avi").write_bytes(video((64, 48), 3, (16000, 16000)))

    said, grown = shown(tmp_path / "v.avi", intrinsics)

    assert "16000x16000 px, above 33554432 pixels" in said
    assert "hint:" in said
    assert grown < MAX_GROWTH_BYTES


@pytest.mark.parametrize("claimed", [(65535, 65535), (0, 0), (1, 65535)])
def test_a_video_of_an_impossible_size_is_one_line(
    tmp_path: Path, intrinsics: Path, claimed: tuple[int, int]
):
    (tmp_path / "v.avi").write_bytes(video((64, 48), 3, claimed))

    said, grown = shown(tmp_path / "v.avi", intrinsics)

    assert "hint:" in said
    assert grown < MAX_GROWTH_BYTES


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.95])
def test_a_video_that_is_cut_off_gives_its_frames_or_one_line(tmp_path: Path, intrinsics: Path, share: float):
    whole = video((64, 48), 20, (64, 48))
    (tmp_path / "v.avi").write_bytes(whole[: int(share * len(whole))])

    said, _ = shown(tmp_path / "v.avi", intrinsics)

    assert said.endswith(" frames") or "hint:" in said


@pytest.mark.parametrize(
    "text", ["#EXTM3U\n#EXTINF:1.0,\nv.avi\n", "ffconcat version 1.0\nfile v.avi\n", "v=0\r\n"]
)
def test_a_playlist_under_the_name_of_a_video_opens_no_other_file(tmp_path: Path, text: str):
    (tmp_path / "v.avi").write_bytes(video((64, 48), 3, (64, 48)))
    (tmp_path / "drive.mp4").write_text(text)

    with pytest.raises(UsageError, match="is a text file, not a video"):
        open_camera(tmp_path / "drive.mp4", intrinsics=Intrinsics(camera=Camera(**_pinhole())))


def test_a_pipe_or_a_device_is_no_video_and_nothing_waits_for_it(tmp_path: Path):
    os.mkfifo(tmp_path / "v.mp4")
    (tmp_path / "zero.mp4").symlink_to("/dev/zero")

    for name in ("v.mp4", "zero.mp4"):
        with pytest.raises(UsageError, match="there is no video"):
            open_camera(tmp_path / name, intrinsics=Intrinsics(camera=Camera(**_pinhole())))


# --- images -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("layout", ["folder", "recording"])
def test_a_small_depth_image_of_a_hundred_million_pixels_is_refused_undecoded(tmp_path: Path, layout: str):
    folder = recording(tmp_path / "x")
    if layout == "folder":
        (folder / "rgb.txt").unlink()
        (folder / "depth.txt").unlink()
    bomb = png(30_000, 4_000)
    assert len(bomb) < 300_000
    (folder / "depth/1.png").write_bytes(bomb)

    said, grown = shown(folder)

    assert "cannot read the image" in said
    assert "33554432 pixels" in said
    assert grown < 150 << 20


# --- recordings -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["../../etc/passwd", "/etc/passwd", "rgb/../../x.png"])
def test_a_list_of_images_names_none_outside_of_its_folder(tmp_path: Path, name: str):
    with pytest.raises(UsageError, match=r"rgb\.txt, line 1 has no finite time stamp, or no path"):
        open_dataset(recording(tmp_path / "x", rgb=f"1.0 {name}\n"))


@pytest.mark.parametrize("stamp", ["nan", "inf", "-inf", "1e999"])
def test_a_time_that_is_no_number_is_refused(tmp_path: Path, stamp: str):
    with pytest.raises(UsageError, match="line 1 has no finite time stamp"):
        open_dataset(recording(tmp_path / "x", depth=f"{stamp} depth/1.png\n"))


def test_lists_of_a_hundred_thousand_images_are_paired_without_comparing_all_with_all():
    first = np.arange(100_000) / 30.0

    pairs = associate_stamps(first.tolist(), (first + 0.001).tolist(), 0.02)

    assert pairs == [(row, row) for row in range(100_000)]


@pytest.mark.parametrize("name", ["rgb.txt", "depth.txt", "intrinsics.json", "groundtruth.txt"])
@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("/dev/zero")])
def test_no_file_of_a_recording_may_be_a_pipe_or_a_device(
    tmp_path: Path, name: str, make: Callable[[Path], None]
):
    folder = recording(tmp_path / "x")
    (folder / name).unlink(missing_ok=True)
    make(folder / name)

    with pytest.raises(UsageError) as raised:
        open_dataset(folder)
    assert raised.value.hint


@pytest.mark.parametrize(
    "changed",
    [
        {"width": float("inf")}, {"width": float("nan")}, {"width": 1e308}, {"height": -48}, {"fx": -60},
        {"fx": float("nan")}, {"cx": 1e9}, {"fx": 1e300}, {"distortion": [1e300, 0, 0, 0]},
        {"distortion": [float("nan")] * 5}, {"distortion": [0.0] * 1000}, {"distortion": "many"},
        {"depth_scale": 0}, {"depth_scale": 5e-324}, {"depth_scale": -5}, {"depth_scale": float("inf")},
        {"rms_px": {"a": 1}}, {"views": "many"}, {"width": [64]},
        {"width": 16384, "height": 16384, "fx": 16384, "fy": 16384, "cx": 8192, "cy": 8192},
    ],
)  # fmt: skip
def test_intrinsics_that_cannot_be_are_one_line(intrinsics: Path, changed: dict[str, object]):
    intrinsics.write_text(json.dumps({**CAMERA, **changed}))

    with pytest.raises(UsageError, match=r"intrinsics\.json") as raised:
        read_intrinsics(intrinsics)
    assert raised.value.hint


# --- NYU --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["enormous", "elsewhere", "linked", "virtual", "no set", "other counts"])
def test_a_labelled_file_holds_images_of_one_size_in_itself(tmp_path: Path, kind: str):
    h5py = pytest.importorskip("h5py", reason="pip install 'rse-pf[vision]'")
    path = tmp_path / "nyu.mat"
    shape = (2, 3, 640, 480)
    with h5py.File(path, "w") as file:
        file.create_dataset("depths", (2, 640, 480), dtype="f4", chunks=(1, 640, 480))
        if kind == "enormous":
            file.create_dataset("images", (2, 3, 50_000, 50_000), dtype="u1", chunks=(1, 3, 640, 480))
        elif kind == "elsewhere":
            file.create_dataset("images", shape, dtype="u1", external=[(b"/etc/passwd", 0, 1843200)])
        elif kind == "linked":
            file["images"] = h5py.ExternalLink("other.mat", "/images")
        elif kind == "virtual":
            file.create_virtual_dataset("images", h5py.VirtualLayout(shape, dtype="u1"))
        elif kind == "no set":
            file.create_group("images")
        else:
            file.create_dataset("images", (2**40, 3, 640, 480), dtype="u1", chunks=(1, 3, 640, 480))

    with pytest.raises(UsageError, match="holds no images and depths"):
        open_dataset(path)


def _pinhole() -> dict[str, float]:
    return {name: value for name, value in CAMERA.items() if name != "depth_scale"}
