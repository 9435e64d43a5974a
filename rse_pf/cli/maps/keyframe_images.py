"""Write the images of a drive's keyframes as JPEG files, named as exported maps refer to them.

The files are in the folder of results only; neither the map nor the platform gets the images.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from client_sdk.frontend import TrackedFrame, load_opencv
from rse_pf.errors import UsageError
from rse_pf.maps.format import IMAGES_FOLDER, MapVersion
from rse_pf.storage.files import replace_file

__all__ = ["KeyframeImages"]

# JPEG quality of the images, 0 to 100.
_QUALITY = 95


class KeyframeImages:
    """The images of the keyframes of one drive, in a folder of results."""

    def __init__(self, out: Path) -> None:
        """Write nothing yet; images go into the folder ``images`` in *out*."""
        self._folder = out / IMAGES_FOLDER
        self._files: dict[float, Path] = {}

    def add(self, tracked: TrackedFrame) -> None:
        """Write the image of a frame if it is a keyframe, or may become one later, else do nothing.

        Raises:
            UsageError: The file cannot be written.
        """
        if not (tracked.keyframe or tracked.status in ("first", "starting")):
            return
        frame, cv2 = tracked.frame, load_opencv()
        good, data = cv2.imencode(
            ".jpg", np.ascontiguousarray(frame.rgb[:, :, ::-1]), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
        )
        file = self._folder / f"frame-{len(self._files)}.jpg"
        try:
            self._folder.mkdir(exist_ok=True)
            replace_file(file, data.tobytes() if good else b"")
        except OSError as error:
            raise UsageError(f"cannot write {file}: {error.strerror}", hint="name another --out") from error
        self._files[frame.timestamp_s] = file

    def finish(self, version: MapVersion | None) -> int:
        """Rename the images of the keyframes of *version*, and remove all others; return how many stay.

        Without a *version*, all are removed.
        """
        named = {} if version is None else {k.timestamp_s: k.image_name for k in version.keyframes}
        for timestamp_s, file in self._files.items():
            if timestamp_s in named:
                file.replace(self._folder / named[timestamp_s])
            else:
                file.unlink()
        return len(named.keys() & self._files.keys())
