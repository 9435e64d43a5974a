"""Parts have names that follow from their contents, and results that are decoded within their types."""

from __future__ import annotations

import msgspec
import pytest

from rse_pf.errors import StoreError
from rse_pf.extensions.batch.parts import (
    PartResult,
    decode_result,
    encode_result,
)


@pytest.mark.parametrize(
    "plain",
    [
        {"arrays": {"a": ["O", [1], b"12345678"]}, "counts": {}},
        {"arrays": {"a": ["f8", [3], b"12345678"]}, "counts": {}},
        {"arrays": 1, "counts": {}},
    ],
)
def test_a_damaged_result_is_a_named_error(plain: object) -> None:
    with pytest.raises(StoreError, match="no result of a part"):
        decode_result("batch/parts/x", msgspec.msgpack.encode(plain))


def test_a_result_is_never_a_pickle() -> None:
    with pytest.raises(StoreError):
        decode_result("x", b"\x80\x04K*.")
    assert encode_result(PartResult())[:1] != b"\x80\x04"
