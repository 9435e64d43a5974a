"""Train the vocabulary of `rse_pf.slam.place_recognition` from rendered worlds, and write it to its file.

No recording is used, so that the package contains no data from images of people's homes.  No test and no
benchmark uses the seeds of these worlds.  The script needs the package faiss-cpu, and takes about two minutes
on one core:

    python scripts/train_places.py
"""

from __future__ import annotations

import argparse
import hashlib
from pathlib import Path

import faiss
import numpy as np
import numpy.typing as npt

from client_sdk.frontend import Frame, FrontEndOptions, extract
from client_sdk.simulator import SIMULATED_CAMERA, true_trajectory
from client_sdk.simulator.renderer import Renderer, add_depth_noise, add_image_noise
from client_sdk.simulator.world import make_world
from rse_pf.maps.descriptors import ORB, Descriptors
from rse_pf.slam.place_recognition import DIRECTIONS, VOCABULARY_FILE, WORDS

WORLDS = range(101, 107)  # seeds of the rendered worlds
FRAMES = 410  # number of frames of one round through a world
RENDERED_EVERY = 8  # every eighth frame of a round is rendered
SEED = 1  # seed of the sample of descriptors and of the clustering
MAX_TRAINING = 20_000  # largest number of descriptors that are clustered
KMEANS_ITERATIONS = 12  # iterations of the k-means clustering


def main() -> None:
    """Render the worlds, train the vocabulary, and write it to its file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=VOCABULARY_FILE)
    out = parser.parse_args().out
    views = [view for world in WORLDS for view in rendered_views(world)]
    words = train_words(views)
    data = _int8(words, 1.0) + _int8(directions_of(views, words, DIRECTIONS), None)
    out.write_bytes(data)
    print(f"{out}: {len(data)} bytes from {len(views)} views, sha256 {hashlib.sha256(data).hexdigest()}")


def rendered_views(seed: int) -> list[Descriptors]:
    """Return the descriptors of the features with depth, for each rendered frame of the world of *seed*."""
    poses = true_trajectory(0, 1, FRAMES, seed).T_world_camera
    painter, options = Renderer(make_world(seed), SIMULATED_CAMERA), FrontEndOptions()
    views = []
    for row in range(0, FRAMES, RENDERED_EVERY):
        rng = np.random.default_rng([seed, row])
        colour, depth_m, cosine = painter.draw(poses[row])
        frame = Frame(
            timestamp_s=0.0, rgb=add_image_noise(colour, rng), depth_m=add_depth_noise(depth_m, cosine, rng),
            camera=SIMULATED_CAMERA,
        )  # fmt: skip
        features = extract(frame, options)
        views.append(features.descriptors[np.isfinite(features.points_camera[:, 2])])
    return views


def train_words(views: list[Descriptors]) -> npt.NDArray[np.float32]:
    """Return ``(32, 256)`` cluster centres of the bits (-1, 1) of a sample of descriptors."""
    stacked = np.concatenate(views)
    if len(stacked) > MAX_TRAINING:
        rows = np.random.default_rng(SEED).choice(len(stacked), MAX_TRAINING, replace=False)
        stacked = stacked[np.sort(rows)]
    kmeans = faiss.Kmeans(
        8 * ORB.size, WORDS, niter=KMEANS_ITERATIONS, seed=SEED, verbose=False, min_points_per_centroid=1
    )
    kmeans.train(np.unpackbits(stacked, axis=1) * np.float32(2.0) - np.float32(1.0))
    centres: npt.NDArray[np.float32] = np.asarray(kmeans.centroids, dtype=np.float32)
    return centres


def directions_of(
    views: list[Descriptors], words: npt.NDArray[np.float32], count: int
) -> npt.NDArray[np.float64]:
    """Return the ``(256, count)`` principal directions of descriptors around their nearest word.

    These are unit vectors along which the bits (-1, 1) differ most from the nearest word, the largest
    differences first.  The mean of the differences is not subtracted.
    """
    scatter = np.zeros((words.shape[1], words.shape[1]))
    for view in views:
        bits = np.unpackbits(view, axis=1) * 2.0 - 1.0
        nearest = np.argmin((words**2).sum(axis=1) - 2.0 * bits @ words.T, axis=1)
        residuals = bits - words[nearest]
        scatter += residuals.T @ residuals
    _, directions = np.linalg.eigh(scatter)
    return np.asarray(directions[:, : -count - 1 : -1], dtype=np.float64)


def _int8(numbers: npt.NDArray[np.floating], largest: float | None) -> bytes:
    scale = 127.0 / (np.abs(numbers).max() if largest is None else largest)
    whole: npt.NDArray[np.int8] = np.rint(numbers * scale).clip(-127, 127).astype(np.int8)
    return whole.tobytes()


if __name__ == "__main__":
    main()
