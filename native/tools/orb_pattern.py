"""Write ``src/orb_pattern.hpp``: where ORB compares intensities, measured with OpenCV's own descriptors.

The 256 pairs of places were learned by Rublee et al., ICCV 2011, sect. 4.3, and every implementation has
them.  Here they are found from the outside: a descriptor's bit says whether the first place of its pair is
darker, so dark and bright half-planes that are moved over a keypoint show where both places lie.

    python native/tools/orb_pattern.py
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

SIZE, CENTRE, REACH = 160, 80, 20
BLUR = 3
Image = npt.NDArray[np.uint8]
ORB = cv2.ORB_create(nfeatures=10, scaleFactor=1.2, nlevels=1, fastThreshold=10)


def bits(bright: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Return the 256 bits at the centre of an image, unrotated."""
    image = np.where(bright, 255, 0).astype(np.uint8)
    keypoint = cv2.KeyPoint(float(CENTRE), float(CENTRE), 31.0, 0.0, 0.0, 0)
    _, descriptors = ORB.compute(image, [keypoint])
    return np.unpackbits(descriptors[0], bitorder="little").astype(bool)


def bounds(
    image_at: Callable[[int], npt.NDArray[np.bool_]],
) -> tuple[npt.NDArray[np.int_], npt.NDArray[np.int_]]:
    """Return the least and the greatest place of the edge that set each bit; least > greatest if none."""
    places = np.arange(-REACH, REACH + 1)
    found = np.array([bits(image_at(place)) for place in places])
    least = np.where(found.any(axis=0), places[found.argmax(axis=0)], REACH + 1)
    greatest = np.where(found.any(axis=0), places[::-1][found[::-1].argmax(axis=0)], -REACH - 1)
    return least, greatest


def measure() -> npt.NDArray[np.int_]:
    """Return ``(256, 4)``: x and y of the first place of each pair, and of the second one.

    The image is blurred over 7x7 pixels before it is read.  With an edge at *t*, bright from *t* on, the
    first place is darker where ``first - 2 <= t <= second + 3``.
    """
    offsets = np.arange(SIZE) - CENTRE
    across = {0: np.broadcast_to(offsets, (SIZE, SIZE)), 1: np.broadcast_to(offsets[:, None], (SIZE, SIZE))}
    pairs = np.full((256, 2, 2), 99)
    for axis, place in across.items():
        least, greatest = bounds(lambda t, place=place: place >= t)
        rising = least <= greatest
        pairs[rising, 0, axis] = least[rising] + 2
        pairs[rising, 1, axis] = greatest[rising] - 3
        least, greatest = bounds(lambda t, place=place: place < t)
        falling = least <= greatest
        pairs[falling, 1, axis] = least[falling] + 2
        pairs[falling, 0, axis] = greatest[falling] - 3
    # Where a pair has one coordinate in common, an edge along the other one tells its places apart, and the
    # image stays dark where the common one is beyond the edge that is moved.
    for axis, place in across.items():
        other = across[1 - axis]
        for row in np.flatnonzero((pairs[:, :, axis] == 99).any(axis=1)):
            low, high = sorted(pairs[row, :, 1 - axis])
            middle = (low + high + 1) // 2
            second_is_higher = pairs[row, 1, 1 - axis] == high
            side = other >= middle if second_is_higher else other < middle
            greatest = max(t for t in range(-REACH, REACH + 1) if bits((place >= t) & side)[row])
            pairs[row, :, axis] = greatest - 3
    return pairs.reshape(256, 4)


def header(pairs: npt.NDArray[np.int_]) -> str:
    """Return the C++ header: all first places, then all second ones."""
    lines = [
        "// Where ORB compares intensities; written by tools/orb_pattern.py.  The first places of the 256",
        "// pairs stand before the second ones; pixels from the keypoint.",
        "#pragma once",
    ]
    for name, columns in (("X", [0, 2]), ("Y", [1, 3])):
        numbers = pairs[:, columns].T.ravel().tolist()
        lines += ["", f"constexpr float kPattern{name}[512] = {{"]
        lines += ["    " + " ".join(f"{each}," for each in numbers[at : at + 24]) for at in range(0, 512, 24)]
        lines.append("};")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Write the header."""
    target = Path(__file__).resolve().parents[1] / "src" / "orb_pattern.hpp"
    target.write_text(header(measure()), encoding="utf-8")


if __name__ == "__main__":
    main()
