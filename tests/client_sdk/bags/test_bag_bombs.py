"""Bags of strangers whose chunks, messages or files decompress to far more than they hold."""

from __future__ import annotations

import io
import re
from pathlib import Path

import numpy as np
import pytest

from client_sdk.bags import BagKind, BagWriter, decompression
from client_sdk.bags.bag_file import BrokenMessage, open_bag_file
from client_sdk.bags.message_types import IMAGE
from rse_pf.errors import UsageError
from tests.kit.small_bags import KINDS, Message, raw_image, stamp_of, write_bag

pytest.importorskip("cv2", reason="pip install 'rse-pf[bags]'")
pytest.importorskip("rosbags", reason="pip install 'rse-pf[bags]'")

LIMIT_BYTES = 1 << 20
"""Of a chunk in these tests; a message of 4 MiB of zeros then shows what one of many GiB would do."""
TOPIC = "/zeros"


def with_zeros(w: BagWriter, messages: list[Message]) -> list[Message]:
    stamp = stamp_of(0)
    return [*messages, (TOPIC, IMAGE, stamp, raw_image(w, stamp, np.zeros((2048, 2048), np.uint8), "mono8"))]


@pytest.mark.parametrize("kind", KINDS)
def test_a_chunk_or_message_is_not_decompressed_beyond_the_bound(
    tmp_path: Path, kind: BagKind, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_bag(tmp_path, kind, change=with_zeros, is_compressed=True)
    files = path.iterdir() if path.is_dir() else [path]
    assert sum(each.stat().st_size for each in files) < 400_000
    with open_bag_file(path) as file:
        assert len(list(file.messages([TOPIC]))) == 1
    monkeypatch.setattr(decompression, "MAX_CHUNK_BYTES", LIMIT_BYTES)

    with open_bag_file(path) as file, pytest.raises(BrokenMessage, match="decompresses to more than 1048576"):
        list(file.messages([TOPIC]))


def test_one_pass_decompresses_a_bounded_multiple_of_the_bag(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_bag(tmp_path, change=with_zeros, is_compressed=True)
    size_bytes = path.stat().st_size
    with open_bag_file(path) as file:
        monkeypatch.setattr(decompression, "_FREE_BYTES", 5 << 20)
        monkeypatch.setattr(decompression, "_EXTRA_BYTES_PER_BAG_BYTE", 1)
        for _ in range(3):  # each pass has the whole allowance again
            file._reader.current_chunk = (-1, io.BytesIO())
            assert len(list(file.messages([TOPIC]))) == 1
        monkeypatch.setattr(decompression, "_FREE_BYTES", (4 << 20) - size_bytes)
        file._reader.current_chunk = (-1, io.BytesIO())
        with pytest.raises(BrokenMessage, match="decompresses to far more bytes than its file has"):
            list(file.messages([TOPIC]))


def test_a_compressed_file_fills_no_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    zstd = pytest.importorskip("backports.zstd")

    path = write_bag(tmp_path, "sqlite3", change=with_zeros)
    with zstd.open(path / "small.db3.zstd", "wb") as packed:
        packed.write((path / "small.db3").read_bytes())
    (path / "small.db3").unlink()
    metadata = (path / "metadata.yaml").read_text()
    metadata = re.sub(r"compression_format: .*", "compression_format: zstd", metadata)
    metadata = re.sub(r"compression_mode: .*", "compression_mode: FILE", metadata)
    (path / "metadata.yaml").write_text(metadata.replace("small.db3", "small.db3.zstd"))
    with open_bag_file(path) as file:
        assert len(list(file.messages([TOPIC]))) == 1
    monkeypatch.setattr(decompression, "_FREE_BYTES", LIMIT_BYTES)
    monkeypatch.setattr(decompression, "_EXTRA_BYTES_PER_BAG_BYTE", 1)

    with pytest.raises(UsageError, match="decompresses to far more bytes than its file has"):
        open_bag_file(path)
