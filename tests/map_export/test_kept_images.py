"""Images of keyframes that a drive keeps are exported with its map."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from rse_pf.cli.main import main
from tests.cli.maps.conftest import state_home
from tests.cli.maps.test_from_camera import PLATFORM
from tests.cli.maps.test_from_camera import folder as video_folder
from tests.cli.maps.test_map_store import folder, report_of
from tests.kit.flat_world import STEP_M, frame_at

cv2 = pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

__all__ = ["folder", "state_home", "video_folder"]


def test_images_of_keyframes_are_kept_if_asked_for_and_exported_with_the_map(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["map", "from-camera", "drive", "--keep-images", *PLATFORM]) == 0
    kept = sorted(Path("out-camera/images").iterdir())
    assert report_of("out-camera")["images"] == len(kept) >= 2
    capsys.readouterr()

    words = ["--format", "nerfstudio", "--images", "out-camera/images", "--out", "nerf"]
    assert main(["map", "export", "out-camera", *words]) == 0

    frames = json.loads(Path("nerf/transforms.json").read_text())["frames"]
    assert len(frames) == len(kept)
    for frame in frames:
        image = cv2.imread(str(Path("nerf") / frame["file_path"]))[:, :, ::-1]
        row = round(frame["transform_matrix"][0][3] / STEP_M)
        difference = np.abs(image.astype(int) - frame_at(row, depth=False).rgb).mean()
        assert difference < 5
    kept[0].unlink()
    assert main(["map", "export", "out-camera", *words[:-1], "colmap"]) == 0
    assert "out-camera/images has no image of 1 keyframe" in capsys.readouterr().out
    assert main(["map", "from-camera", "drive", "--out", "bare", *PLATFORM]) == 0
    assert not Path("bare/images").exists()
