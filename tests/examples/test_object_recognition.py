"""The example service finds a cover by one picture, and AprilTags, in synthetic photos."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rse_pf.cli.main import main
from rse_pf.errors import BadRequest
from rse_pf.geometry import Array, exp_se3, pose_difference
from rse_pf.services.custom.installed import read_service
from rse_pf.services.custom.runtime import Runtime, open_runtime

cv2 = pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")
from tests.kit.rendered_inputs import SCENE_CAMERA, TAG_M, draw_scene  # noqa: E402  after importorskip

FOLDER = Path(__file__).parents[2] / "examples" / "robots" / "object_recognition_service"
COVER = FOLDER / "objects" / "cover.png"
SEEDS = range(4)


def placed(seed: int) -> tuple[Array, Array]:
    """Return the poses of a cover at 0.6 m and a tag at 1.2 m, both tilted."""
    rng = np.random.default_rng(seed)
    cover = exp_se3(np.concatenate([[0.0, 0.0, 0.0], rng.uniform(-0.4, 0.4, 3)]))
    cover[:3, 3] = [-0.12, rng.uniform(-0.08, 0.08), 0.6]
    tag = exp_se3(np.concatenate([[0.0, 0.0, 0.0], rng.uniform(0.2, 0.5, 3) * rng.choice([-1, 1], 3)]))
    tag[:3, 3] = [0.35, rng.uniform(-0.2, 0.2), 1.2]
    return cover, tag


def request_of(image: Any, quality: int = 90) -> dict[str, Any]:
    camera = SCENE_CAMERA
    return {
        "image": cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, quality))[1].tobytes(),
        "camera": [camera.fx, camera.fy, camera.cx, camera.cy],
        "tag_m": TAG_M,
    }


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Runtime:
    """The service without its sandbox."""
    return open_runtime(read_service(FOLDER), tmp_path_factory.mktemp("scratch"))


@pytest.mark.parametrize("seed", SEEDS)
def test_a_cover_and_a_tag_are_found_where_they_are(service: Runtime, seed: int) -> None:
    cover, tag = placed(seed)

    found = service.call(request_of(draw_scene(COVER, cover, tag, tag=7, seed=seed))).found

    assert [each.name for each in found] == ["cover", "tag36h11:7"]
    metres, degrees = pose_difference(found[0].T_camera_object.reshape(4, 4), cover)
    assert metres <= 0.002
    assert degrees <= 0.5
    metres, degrees = pose_difference(found[1].T_camera_object.reshape(4, 4), tag)
    assert metres <= 0.02
    assert degrees <= 4.0


@pytest.mark.parametrize(
    "wrong",
    [{"image": b""}, {"image": b"no image"}, {"camera": [525.0]}, {"camera": [0.0] * 4}, {"tag_m": 0.0}],
)
def test_a_wrong_request_is_refused(service: Runtime, wrong: dict[str, Any]) -> None:
    request = request_of(np.full((48, 64), 128, np.uint8))

    with pytest.raises(BadRequest):
        service.call(request | wrong)


@pytest.mark.system
def test_the_recorded_requests_give_their_replies_in_the_sandbox(
    capsys: pytest.CaptureFixture[str],
) -> None:
    count = len(list((FOLDER / "requests").glob("*.json")))

    assert main(["service", "test", str(FOLDER)]) == 0

    assert f"{count} of {count} recorded requests as expected" in capsys.readouterr().out
