"""XFeat, features that were learned: ``rse-pf demo --features xfeat:xfeat`` here; the extra ``xfeat``."""

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import onnxruntime

from client_sdk.plugins import FoundFeatures

_OPTIONS = onnxruntime.SessionOptions()
_OPTIONS.intra_op_num_threads = 1
_NETWORK = onnxruntime.InferenceSession(
    Path(__file__).with_name("xfeat_weights") / "xfeat.onnx", _OPTIONS, providers=["CPUExecutionProvider"]
)


def xfeat(rgb: npt.NDArray[np.uint8]) -> FoundFeatures:
    """Find the 2,000 best XFeat features of an image of at least 32 x 32 pixels."""
    height, width = rgb.shape[0] // 32 * 32, rgb.shape[1] // 32 * 32
    image = cv2.resize(rgb, (width, height)).astype(np.float32).transpose(2, 0, 1)[None]
    dense, logits, reliability = (output[0] for output in _NETWORK.run(None, {"image": image}))
    shares = np.exp(logits - logits.max(axis=0))  # 64 pixels of each cell of 8 x 8, and "nothing here"
    shares = (shares[:64] / shares.sum(axis=0)).reshape(8, 8, height // 8, width // 8)
    heat = shares.transpose(2, 0, 3, 1).reshape(height, width)
    y, x = np.nonzero((heat > 0.05) & (heat == cv2.dilate(heat, np.ones((5, 5)))))
    scores = heat[y, x] * cv2.resize(reliability[0], (width, height))[y, x]
    best = np.argsort(-scores, kind="stable")[:2000]
    y, x, scores = y[best], x[best], scores[best]
    # The descriptors of the four cells around a pixel, by its distance to their centres.
    dense = np.pad(dense / np.linalg.norm(dense, axis=0), ((0, 0), (1, 1), (1, 1)), mode="edge")
    (row, down), (column, right) = np.divmod((y + 4.5) / 8, 1), np.divmod((x + 4.5) / 8, 1)
    above, below = (
        dense[:, r, column.astype(int)] * (1 - right) + dense[:, r, column.astype(int) + 1] * right
        for r in (row.astype(int), row.astype(int) + 1)
    )
    scale = np.array([rgb.shape[1] / width, rgb.shape[0] / height])
    pixels = (np.stack([x, y], axis=1) + 0.5) * scale - 0.5
    return FoundFeatures(pixels=pixels, scores=scores, descriptors=(above * (1 - down) + below * down).T)
