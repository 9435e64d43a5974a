"""Images of strangers: judged by their heads, and refused with one line before they take anything."""

from __future__ import annotations

import time
import zlib
from typing import Any

import numpy as np
import pytest

cv2 = pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")
from rse_pf import images  # noqa: E402
from rse_pf.errors import BadRequest, LimitExceeded  # noqa: E402
from rse_pf.images import MAX_PHOTO_PIXELS, decode_photo, photo_size  # noqa: E402
from tests.kit.hostile_images import HARMLESS, chunk, hostile_images, photo, png  # noqa: E402

IMAGES = hostile_images()
ADAM7 = (
    (0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2),
)  # fmt: skip
"""First column and row, and steps, of the seven passes of an interlaced PNG (W3C PNG, Sect. 8.2)."""


@pytest.mark.parametrize("kind", [".jpg", ".png"])
@pytest.mark.parametrize("size", [(640, 480), (480, 640), (8, 8)])
def test_a_photo_has_the_size_that_its_head_states(kind: str, size: tuple[int, int]) -> None:
    data = photo(*size, kind)

    assert photo_size(data) == size
    assert decode_photo(data).shape == (size[1], size[0], 3)


def test_the_first_channel_is_red_and_grey_images_have_three() -> None:
    red = np.zeros((16, 16, 3), np.uint8)
    red[:, :, 2] = 255

    assert decode_photo(bytes(cv2.imencode(".png", red)[1]))[0, 0].tolist() == [255, 0, 0]
    grey = bytes(cv2.imencode(".jpg", np.full((16, 16), 99, np.uint8))[1])
    assert decode_photo(grey)[3, 3].tolist() == [99, 99, 99]


@pytest.mark.parametrize("name", IMAGES)
def test_a_hostile_image_is_refused_in_one_line_or_harmless(name: str) -> None:
    if name.startswith(HARMLESS):
        height, width, _ = decode_photo(IMAGES[name]).shape
        assert height * width <= MAX_PHOTO_PIXELS
        return
    with pytest.raises((BadRequest, LimitExceeded)) as refused:
        decode_photo(IMAGES[name])
    assert "\n" not in refused.value.message
    assert refused.value.hint


@pytest.mark.parametrize(
    "name", ["jpeg of 65535x65535", "jpeg of ten thousand scans", "jpeg of many scans", "png of 65536x257"]
)
def test_a_bomb_is_refused_before_anything_is_decoded(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def load() -> Any:
        raise AssertionError("nothing may be decoded")

    monkeypatch.setattr(images, "load_opencv", load)

    with pytest.raises(LimitExceeded):
        decode_photo(IMAGES[name])


def test_what_a_png_holds_beside_its_pixels_costs_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    bomb = chunk(b"zTXt", b"a\0\0" + zlib.compress(bytes(1 << 25), 9))
    plain, began_s = png(), time.process_time()

    for extra in (bomb * 100, chunk(b"tIME", b"x") * 5000, chunk(b"gAMA", b"\0\0\1\0")):
        np.testing.assert_array_equal(decode_photo(png(before=extra)), decode_photo(plain))

    assert time.process_time() - began_s < 0.5
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("colour", [0, 2, 4, 6])
@pytest.mark.parametrize("size", [(1, 1), (3, 5), (64, 48), (1, 300), (300, 1)])
def test_an_interlaced_png_inflates_to_more_than_a_plain_one_and_is_a_photo(
    colour: int, size: tuple[int, int]
) -> None:
    width, height = size
    channels = {0: 1, 2: 3, 4: 2, 6: 4}[colour]
    rows = bytearray()
    for x, y, step_x, step_y in ADAM7:
        columns = len(range(x, width, step_x))
        rows += bytes(len(range(y, height, step_y)) * (1 + columns * channels) * (columns > 0))

    image = decode_photo(png(width, height, colour=colour, interlace=1, pixels=zlib.compress(rows)))

    assert image.shape == (height, width, 3)


def test_pixels_above_what_the_head_states_are_refused_before_they_are_inflated() -> None:
    data = png(pixels=zlib.compress(bytes(1 << 28), 9))
    began_s = time.process_time()

    with pytest.raises(BadRequest, match="above 9408 bytes"):
        decode_photo(data)

    assert time.process_time() - began_s < 0.2
