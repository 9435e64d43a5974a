"""Parts have names that follow from their contents, and results that are decoded within their types."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from rse_pf.errors import StoreError
from rse_pf.extensions.batch.parts import (
    Part,
    PartResult,
    decode_part,
    decode_result,
    encode_part,
    encode_result,
    put_input,
    read_result,
)
from rse_pf.storage.object_store import MemoryStore


def test_a_part_is_named_by_all_that_it_computes_from() -> None:
    part = Part(kind="links", inputs=("a", "b"), arguments={"rows": (0, 10)})

    assert decode_part(encode_part(part)).name == part.name
    others = [
        msgspec.structs.replace(part, kind="agree"),
        msgspec.structs.replace(part, inputs=("b", "a")),
        msgspec.structs.replace(part, arguments={"rows": (0, 11)}),
    ]
    assert len({each.name for each in [part, *others]}) == 4


def test_results_come_back_as_they_were() -> None:
    result = PartResult(
        arrays={"a": np.arange(6).reshape(2, 3), "b": np.zeros((0, 4), dtype=np.float32)}, counts={"few": 2}
    )
    store = MemoryStore()

    found = read_result(store, put_input(store, result))

    assert found.counts == {"few": 2}
    assert np.array_equal(found.arrays["a"], result.arrays["a"])
    assert found.arrays["b"].shape == (0, 4)
    assert found.arrays["b"].dtype == np.float32


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
