"""Readers of recordings, on generated files with values computed by hand."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from client_sdk.datasets import associate_stamps, nyu, open_dataset
from rse_pf.errors import UsageError

cv2 = pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")


def write_tum(
    folder: Path, stamps: list[float], *, depth_delay_s: float = 0.0, intrinsics: bool = True,
    distortion: tuple[float, ...] = (), scale: float = 1000, size: tuple[int, int] = (48, 64),
) -> Path:  # fmt: skip
    """Write frames whose red channel is the frame number and whose depth is 1000 + number."""
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    lists: dict[str, list[str]] = {"rgb": ["# timestamp filename"], "depth": ["# timestamp filename"]}
    for number, stamp in enumerate(stamps):
        bgr = np.zeros((*size, 3), np.uint8)
        bgr[..., 2] = number
        depth = np.full(size, 1000 + number, np.uint16)
        depth[0, 0], depth[0, 1] = 0, 65535
        cv2.imwrite(str(folder / f"rgb/{number}.png"), bgr)
        cv2.imwrite(str(folder / f"depth/{number}.png"), depth)
        lists["rgb"].append(f"{stamp:.6f} rgb/{number}.png")
        lists["depth"].append(f"{stamp + depth_delay_s:.6f} depth/{number}.png")
    for name, lines in lists.items():
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    if intrinsics:
        values = {"fx": 60, "fy": 61, "cx": 31.5, "cy": 23.5, "width": size[1], "height": size[0]}
        values |= {"distortion": list(distortion), "depth_scale": scale}
        (folder / "intrinsics.json").write_text(json.dumps(values))
    return folder


def test_a_tum_folder_becomes_frames_in_metres_with_red_first(tmp_path: Path):
    dataset = open_dataset(write_tum(tmp_path / "x", [0.0, 0.1, 0.2], depth_delay_s=0.015))

    frames = list(dataset)

    assert [frame.timestamp_s for frame in frames] == [0.0, 0.1, 0.2]
    assert frames[2].rgb[5, 5].tolist() == [2, 0, 0]
    assert frames[2].depth_m[5, 5] == np.float32(1.002)
    assert frames[2].depth_m[0, 0] == frames[2].depth_m[0, 1] == 0.0  # no reading, written in two ways
    assert (dataset.camera.fx, dataset.camera.fy, dataset.camera.cy) == (60.0, 61.0, 23.5)
    assert dataset.truth is None


def test_images_more_than_20_ms_apart_are_no_frame(tmp_path: Path):
    with pytest.raises(UsageError, match=r"0\.02 s"):
        open_dataset(write_tum(tmp_path / "x", [0.0, 0.1], depth_delay_s=0.03))


def test_each_image_is_used_once_by_its_nearest_partner():
    assert associate_stamps([0.0, 0.01, 0.1], [0.009, 0.119, 0.2], 0.02) == [(1, 0), (2, 1)]
    assert associate_stamps([0.0], [], 0.02) == []


def test_ground_truth_and_reference_poses_are_distinguished(tmp_path: Path):
    folder = write_tum(tmp_path / "x", [0.0])
    (folder / "reference_poses.txt").write_text("0 1 2 3 0 0 0 1\n")
    assert open_dataset(folder).truth_kind == "reference"
    (folder / "groundtruth.txt").write_text("0 4 5 6 0 0 0 1\n")
    dataset = open_dataset(folder)
    assert dataset.truth_kind == "ground truth"
    assert dataset.truth is not None
    assert dataset.truth.positions.tolist() == [[4, 5, 6]]


@pytest.mark.parametrize(
    ("name", "fx", "cy"),
    [("rgbd_dataset_freiburg1_xyz", 517.3, 255.3), ("freiburg2_desk", 520.9, 249.7), ("mine", 525.0, 239.5)],
)
def test_a_plain_tum_folder_takes_the_benchmarks_intrinsics(tmp_path: Path, name: str, fx: float, cy: float):
    dataset = open_dataset(write_tum(tmp_path / name, [0.0], intrinsics=False, size=(480, 640)))

    assert (dataset.camera.fx, dataset.camera.cy) == (fx, cy)
    assert next(iter(dataset)).depth_m[240, 320] == np.float32(1000 / 5000)


def test_lens_distortion_is_removed_from_colour_and_depth(tmp_path: Path):
    folder = write_tum(tmp_path / "x", [0.0], distortion=(0.2, 0, 0, 0, 0))
    depth = np.tile(np.arange(1000, 1064, dtype=np.uint16), (48, 1))
    cv2.imwrite(str(folder / "depth/0.png"), depth)

    frame = next(iter(open_dataset(folder)))

    # pixel (52, 23): x = 20.5 / 60, y = -0.5 / 61; radius^2 = 0.11680; the lens moved it by a factor of
    # 1 + 0.2 r^2 = 1.02336, to column 31.5 + 20.5 * 1.02336 = 52.479, whose nearest reading is 1.052 m
    assert frame.depth_m[23, 52] == np.float32(1.052)
    # pixel (56, 23): radius^2 = 0.16674, factor 1.03335, column 56.817: reading 1.057
    assert frame.depth_m[23, 56] == np.float32(1.057)


def test_a_rate_plays_the_frames_nearest_before_its_due_times(tmp_path: Path):
    dataset = open_dataset(write_tum(tmp_path / "x", [0.0, 0.1, 0.2, 0.3, 0.38, 0.5]))

    assert dataset.thinned(5).timestamps_s == (0.0, 0.2, 0.38)
    assert dataset.thinned(10).timestamps_s == dataset.timestamps_s
    assert [frame.timestamp_s for frame in dataset.thinned(5)] == [0.0, 0.2, 0.38]
    for rate in (0.0, -1.0, float("nan")):
        with pytest.raises(UsageError):
            dataset.thinned(rate)


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "played"),
    [
        ("tum_fr1_rpy_start", {60: 330, 30: 330, 15: 165, 10: 110, 5: 55}),
        ("7scenes_redkitchen", {30: 250, 10: 250, 5: 125}),
    ],
)
def test_rates_of_real_recordings(recordings: Path, name: str, played: dict[int, int]):
    if not (recordings / name).exists():
        pytest.skip(f"no recording {name}")
    dataset = open_dataset(recordings / name)

    assert {rate: len(dataset.thinned(rate)) for rate in played} == played


def test_robots_take_contiguous_shares_that_cover_everything_once(tmp_path: Path):
    dataset = open_dataset(write_tum(tmp_path / "x", [i / 10 for i in range(7)]))

    shares = [dataset.share(robot, 3).rows for robot in range(3)]

    assert shares == [(0, 1, 2), (3, 4, 5), (6,)]
    assert [len(dataset.share(robot, 5)) for robot in range(5)] == [2, 2, 2, 1, 0]
    assert dataset.thinned(5).share(1, 2).rows == (4, 6)
    with pytest.raises(UsageError):
        dataset.share(3, 3)


@pytest.mark.parametrize(
    ("harm", "told"),
    [
        (lambda folder: (folder / "rgb.txt").unlink(), "no rgb.txt in"),
        (lambda folder: (folder / "depth.txt").unlink(), "no depth.txt in"),
        (lambda folder: (folder / "rgb.txt").write_text("zero rgb/0.png\n"), "line 1"),
        (lambda folder: (folder / "intrinsics.json").write_text("{"), "intrinsics.json"),
        (lambda folder: (folder / "intrinsics.json").write_text('{"fx": 1}'), "fy"),
        (lambda folder: (folder / "rgb/0.png").write_bytes(b"broken"), "cannot read the image"),
        (lambda folder: (folder / "depth/0.png").unlink(), "cannot read the image"),
        (lambda folder: cv2.imwrite(str(folder / "depth/0.png"), np.ones((48, 64), np.uint8)), "16-bit"),
        (lambda folder: cv2.imwrite(str(folder / "rgb/0.png"), np.ones((9, 9, 3), np.uint8)), "is 9x9 px"),
    ],
)
def test_problems_are_reported_in_one_line_with_a_hint(tmp_path: Path, harm, told: str):
    folder = write_tum(tmp_path / "x", [0.0])
    harm(folder)
    with pytest.raises(UsageError, match=told) as caught:
        list(open_dataset(folder))
    assert "\n" not in caught.value.message
    assert caught.value.hint


def test_depth_in_the_wrong_unit_is_noticed(tmp_path: Path):
    with pytest.raises(UsageError, match="median depth"):
        list(open_dataset(write_tum(tmp_path / "x", [0.0], scale=1)))


def test_raw_depth_becomes_metres(tmp_path: Path):
    raw = np.array([[0, 600, 741, 1057, 1058, 2047]], np.uint16)
    # 351.3 / 492.5, 351.3 / 351.5, 351.3 / 35.5; 1058 would be 10.18 m, 2047 is "no reading"
    (tmp_path / "d.pgm").write_bytes(b"P5\n6 1\n65535\n" + raw.astype("<u2").tobytes())
    depth_m = nyu.read_raw_depth(tmp_path / "d.pgm")
    np.testing.assert_allclose(depth_m, [[0, 0.713299, 0.999431, 9.895775, 0, 0]], atol=1e-5)


def test_depth_is_registered_where_the_colour_camera_sees_it():
    depth_m = np.zeros((480, 640), np.float32)
    depth_m[238, 313] = 2.0

    registered = nyu.register_depth(depth_m)

    # Nearly on the depth camera's axis: x = -0.0002 + R[0,2] z - 0.0250 = -0.0338 and
    # y = -0.0015 + 0.0073 + 0.0003 = 0.0061, so column 325.58 - 518.86 * 0.0338 / 2 = 316.8
    # and row 253.74 + 519.47 * 0.0061 / 2 = 255.3
    assert np.argwhere(registered > 0).tolist() == [[255, 317]]
    assert registered[255, 317] == pytest.approx(1.999, abs=0.001)


# --- NYU Depth V2 -------------------------------------------------------------------------------


def test_the_nearer_of_two_surfaces_hides_the_other():
    depth_m = np.full((480, 640), 4.0, np.float32)
    depth_m[200:280, 280:360] = 1.0

    registered = nyu.register_depth(depth_m)

    # The patch lands on columns 281..352, rows 220..291; the wall behind it must not shine through.
    patch = registered[225:285, 285:348]
    assert patch[patch > 0].max() < 1.01


def write_pgm(path: Path, raw: np.ndarray) -> None:
    path.write_bytes(b"P5\n640 480\n65535\n" + raw.astype("<u2").tobytes())


def test_a_raw_dump_is_paired_by_the_times_in_its_names(tmp_path: Path):
    for stamp in ("100.000000", "100.033000"):
        write_pgm(tmp_path / f"d-{stamp}-5.pgm", np.full((480, 640), 741, np.uint16))
    (tmp_path / "d-100.066000-5.pgm").write_bytes(b"")  # the published dump has such files
    for stamp, red in (("99.990000", 10), ("100.040000", 20), ("100.070000", 30), ("100.500000", 40)):
        body = np.zeros((480, 640, 3), np.uint8)
        body[..., 0] = red
        (tmp_path / f"r-{stamp}-7.ppm").write_bytes(b"P6\n640 480\n255\n" + body.tobytes())

    dataset = open_dataset(tmp_path)
    frames = list(dataset)

    (doubt,) = dataset.log.doubts
    assert doubt.sentence.endswith("left out, damaged or empty: d-100.066000-5.pgm")
    assert any("is that of the toolbox of NYU Depth V2: fx 518.86" in note for note in dataset.notes)
    assert [frame.timestamp_s for frame in frames] == [100.0, 100.033]
    assert [frame.rgb[240, 320].tolist() for frame in frames] == [[10, 0, 0], [20, 0, 0]]
    assert np.median(frames[0].depth_m) == pytest.approx(0.999, abs=0.01)
    assert frames[0].camera.fx == pytest.approx(518.8579)


def test_the_labelled_file_is_read_with_its_axes_turned(tmp_path: Path):
    h5py = pytest.importorskip("h5py", reason="pip install 'rse-pf[vision]'")
    images = np.zeros((3, 3, 640, 480), np.uint8)
    images[1, 2, 100, 50] = 77  # blue at row 50, column 100
    depths = np.zeros((3, 640, 480), np.float32)
    depths[1, 100, 50] = 2.5
    with h5py.File(tmp_path / "nyu.mat", "w") as file:
        file["images"], file["rawDepths"], file["depths"] = images, depths, depths + 9
        cells = []
        for name in ("bath", "cafe", "cafe"):
            file[f"#refs#/{len(cells)}"] = np.array([[ord(letter)] for letter in name], np.uint16)
            cells.append(file[f"#refs#/{len(cells)}"].ref)
        file.create_dataset("scenes", data=np.array([cells], dtype=h5py.ref_dtype), dtype=h5py.ref_dtype)

    cafe = open_dataset(tmp_path / "nyu.mat", scene="cafe")

    frame = next(iter(cafe))
    assert (len(cafe), len(open_dataset(tmp_path / "nyu.mat"))) == (2, 3)
    assert frame.rgb[50, 100].tolist() == [0, 0, 77]
    assert frame.depth_m[50, 100] == 2.5
    assert any("1 s between images is assumed" in note for note in cafe.notes)
    with pytest.raises(UsageError, match="no scene attic"):
        open_dataset(tmp_path / "nyu.mat", scene="attic")


@pytest.mark.parametrize("resized", ["rgb", "depth"])
@pytest.mark.parametrize("distortion", [(), (0.2, 0, 0, 0, 0)])
def test_an_image_of_another_size_than_the_camera_is_refused(
    tmp_path: Path, resized: str, distortion: tuple[float, ...]
):
    folder = write_tum(tmp_path / "x", [0.0], distortion=distortion)
    path = folder / resized / "0.png"
    cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[::2, ::2])

    with pytest.raises(UsageError, match=r"0\.png is 32x24 px, the camera of the recording 64x48 px") as told:
        next(iter(open_dataset(folder)))
    assert "intrinsics.json" in told.value.hint


def test_intrinsics_that_are_named_count_before_those_of_the_folder(tmp_path: Path):
    folder = write_tum(tmp_path / "x", [0.0])
    own = json.loads((folder / "intrinsics.json").read_text())
    named = tmp_path / "named.json"
    named.write_text(json.dumps({**own, "fx": own["fx"] + 7, "depth_scale": 2 * own["depth_scale"]}))

    before, after = open_dataset(folder), open_dataset(folder, intrinsics=named)

    assert after.camera.fx == before.camera.fx + 7
    assert np.array_equal(2 * next(iter(after)).depth_m, next(iter(before)).depth_m)


def test_named_intrinsics_of_a_folder_with_depth_say_its_scale(tmp_path: Path):
    folder = write_tum(tmp_path / "x", [0.0])
    own = json.loads((folder / "intrinsics.json").read_text())
    del own["depth_scale"]
    (tmp_path / "named.json").write_text(json.dumps(own))
    with pytest.raises(UsageError, match="depth_scale"):
        open_dataset(folder, intrinsics=tmp_path / "named.json")
    with pytest.raises(UsageError, match="there is no"):
        open_dataset(folder, intrinsics=tmp_path / "none.json")


@pytest.mark.parametrize(
    ("name", "units", "refused"),
    [
        ("mine", 800, "0.16 m at assumed 5000 units a metre, not within 0.2..6 m"),
        ("mine", 35_000, "7 m at assumed 5000 units a metre"),
        ("mine", 5000, ""),
        ("rgbd_dataset_freiburg2_hall", 35_000, ""),  # the benchmark states the unit
        ("rgbd_dataset_freiburg2_hall", 200, "0.04 m at 5000 units a metre, not within 0.05..30 m"),
    ],
)
def test_a_unit_of_depth_that_is_assumed_has_narrow_limits(
    tmp_path: Path, name: str, units: int, refused: str
) -> None:
    folder = write_tum(tmp_path / name, [0.0], size=(480, 640), intrinsics=False)
    cv2.imwrite(str(folder / "depth/0.png"), np.full((480, 640), units, np.uint16))

    if refused:
        with pytest.raises(UsageError, match=re.escape(refused)):
            open_dataset(folder)
    else:
        assert open_dataset(folder).has_depth


def test_colour_images_without_depth_are_left_out_and_counted(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "drive", [0.0, 0.1, 0.2, 0.3, 0.4])
    lines = (folder / "depth.txt").read_text().splitlines()
    (folder / "depth.txt").write_text("\n".join(lines[:-2]) + "\n")

    dataset = open_dataset(folder)

    assert len(dataset) == 3
    assert dataset.log.doubts[0].sentence.startswith("2 of 5 colour images")


def test_assumed_intrinsics_are_reported(tmp_path: Path):
    folder = write_tum(tmp_path / "mine", [0.0])
    for path in (folder / "rgb/0.png", folder / "depth/0.png"):
        cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), (640, 480)))
    (folder / "intrinsics.json").unlink()
    (note,) = open_dataset(folder).notes
    assert "has no intrinsics.json, so a Kinect's are assumed: fx 525 fy 525" in note
    assert "depth_scale 5000" in note
    assert f"rse-pf camera calibrate {folder} --depth-scale 5000" in note

    assert open_dataset(write_tum(tmp_path / "known", [0.0])).notes == ()


def test_no_intrinsics_are_assumed_for_images_of_another_size(tmp_path: Path):
    folder = write_tum(tmp_path / "mine", [0.0])
    (folder / "intrinsics.json").unlink()
    with pytest.raises(UsageError, match="are not those of the benchmark's cameras") as refused:
        open_dataset(folder)
    assert f"rse-pf camera calibrate {folder}" in refused.value.hint


@pytest.mark.parametrize(
    ("images", "file", "mapped"),
    [("image_0", "calib.txt", "."), ("mav0/cam0/data", "mav0/cam0/sensor.yaml", "mav0/cam0/data")],
)
def test_a_missing_calibration_is_named_with_the_way_without_it(
    tmp_path: Path, images: str, file: str, mapped: str
):
    (tmp_path / images).mkdir(parents=True)
    with pytest.raises(UsageError, match=f"there is no {tmp_path / file}") as refused:
        open_dataset(tmp_path)
    assert f"then rse-pf map from-camera {tmp_path / mapped}" in refused.value.hint
