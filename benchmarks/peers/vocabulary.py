"""Train a vocabulary for ORB-SLAM3 from images, as the text file that its library DBoW2 reads.

ORB features of each image are clustered into a tree of 10 branches and 6 levels, by k-medians of bits; a word
has the weight ``log(number of images / number of images that show the word)``.  The same images give the same
file.
The file belongs to the images, and is not committed.

    python -m benchmarks peers.vocabulary ../shared/data --every 5 --words words.txt

Source:
    Galvez-Lopez and Tardos, "Bags of Binary Words for Fast Place Recognition in Image Sequences", T-RO 2012.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from benchmarks.frame.registry import benchmark
from client_sdk.frontend import describe
from rse_pf.images import load_opencv, read_image

__all__ = ["Node", "text_of", "train"]

Bits = npt.NDArray[np.uint8]

_BRANCHES = 10  # number of clusters into which a node of the vocabulary tree is divided
_LEVELS = 6  # number of levels of the vocabulary tree below its root
_ROUNDS = 8  # largest number of iterations of a clustering
_MIN_SPLIT = 24  # fewest descriptors of a cluster that is divided further; a smaller cluster is a word
_FEATURES = 1000  # number of ORB features of an image
_TF_IDF = 0  # DBoW2's number of the weighting TF-IDF
_L1 = 0  # DBoW2's number of the score by the L1 distance
_FOLDERS = ("rgb", "image_0", "data")
"""Folders of colour or grey images in the layouts of TUM, KITTI and EuRoC."""


@dataclass(slots=True, eq=False)
class Node:
    """A node of the tree: its ``(32,)`` descriptor, its parent's number, and its weight if it is a word."""

    descriptor: Bits
    parent: int
    rows: npt.NDArray[np.int64]
    depth: int
    weight: float = 0.0
    children: list[int] = field(default_factory=list)


def train(descriptors: Bits, images: npt.NDArray[np.int64]) -> list[Node]:
    """Return the nodes of the tree, the root first, each parent before its children.

    Args:
        descriptors: ``(n, 32)``.
        images: ``(n,)``, for each descriptor the number of the image that shows it, from 0.
    """
    rng = np.random.default_rng(0)
    nodes = [Node(np.zeros(32, np.uint8), parent=0, rows=np.arange(len(descriptors)), depth=0)]
    for number, node in enumerate(nodes):  # the list grows while it is read: breadth first
        if node.depth < _LEVELS and len(node.rows) >= _MIN_SPLIT:
            for centre, rows in _split(descriptors, node.rows, rng):
                node.children.append(len(nodes))
                nodes.append(Node(centre, parent=number, rows=rows, depth=node.depth + 1))
        if not node.children:
            shown_by = len(np.unique(images[node.rows]))
            node.weight = float(np.log((images.max() + 1) / max(1, shown_by)))
    return nodes


def text_of(nodes: Sequence[Node]) -> str:
    """Return the tree as text for DBoW2, without a last newline: DBoW2 would read an empty line as a node."""
    lines = [f"{_BRANCHES} {_LEVELS} {_L1} {_TF_IDF}"]
    for node in nodes[1:]:
        bits = " ".join(map(str, node.descriptor))
        lines.append(f"{node.parent} {int(not node.children)} {bits} {node.weight:.6g}")
    return "\n".join(lines)


def _split(
    descriptors: Bits, rows: npt.NDArray[np.int64], rng: np.random.Generator
) -> Iterator[tuple[Bits, npt.NDArray[np.int64]]]:
    """Divide the descriptors *rows* into clusters; yield centre and rows of each (none if all are equal)."""
    signs = np.unpackbits(descriptors[rows], axis=1).astype(np.float32) * 2 - 1
    centres = signs[rng.choice(len(rows), size=min(_BRANCHES, len(rows)), replace=False)]
    owner = np.zeros(len(rows), dtype=np.int64)
    for _ in range(_ROUNDS):
        nearest = (signs @ centres.T).argmax(axis=1)
        if np.array_equal(nearest, owner):
            break
        owner = nearest
        for each in np.unique(owner):
            centres[each] = np.where(signs[owner == each].sum(axis=0) >= 0, 1.0, -1.0)
    found = np.unique(owner)
    if len(found) > 1:
        for each in found:
            yield np.packbits(centres[each] > 0), rows[owner == each]


def _images(folders: Sequence[Path], every: int) -> list[Path]:
    paths = [
        path
        for folder in folders
        for path in sorted(folder.rglob("*"))
        if path.parent.name in _FOLDERS and path.suffix in (".jpg", ".png")
    ]
    return paths[::every]


@benchmark()
def run_benchmark(
    *, folders: tuple[Path, ...], words: Annotated[Path, "the file to write"] = Path("words.txt"),
    every: Annotated[int, "take each n-th image"] = 5,
) -> dict[str, Any]:  # fmt: skip
    """Train on the images below the folders, and write the file."""
    paths = _images(folders, every)
    cv2 = load_opencv()
    described = []
    for path in paths:
        image = read_image(path, cv2.IMREAD_COLOR)
        assert image is not None, path
        described.append(describe(image, _FEATURES, is_spread=True).descriptors)
    images = np.repeat(np.arange(len(described)), [len(each) for each in described])
    nodes = train(np.concatenate(described), images)
    words.write_text(text_of(nodes), encoding="ascii")
    count = sum(not node.children for node in nodes)
    return {"images": len(paths), "descriptors": len(images), "words": count}
