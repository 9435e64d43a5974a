"""What the link of the conformance table does to messages, and what the client of 150 lines imports."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

HERE = Path(__file__).parent


def module(path: Path) -> Any:
    spec = importlib.util.spec_from_file_location(f"conformance_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = made  # dataclasses look their module up
    spec.loader.exec_module(made)
    return made


link = module(HERE / "link.py")


def test_the_raw_client_has_at_most_150_lines_and_imports_nothing_of_the_platform() -> None:
    for name in ("raw.py", "raw_scenarios.py"):
        lines = (HERE / "drivers" / name).read_text(encoding="utf-8").splitlines()
        assert not [line for line in lines if "import" in line and ("rse_pf" in line or "client_sdk" in line)]
        assert name != "raw.py" or len(lines) <= 150


def frame(payload: bytes, first: int, mask: bytes = b"") -> bytes:
    masked = bytes(b ^ mask[i % 4] for i, b in enumerate(payload)) if mask else payload
    return link._frame(first, masked, mask)


def read(data: bytes) -> list[tuple[int, bytes]]:
    """Return the first byte and the unmasked payload of every frame, read anew from RFC 6455, 5.2."""
    found = []
    while data:
        size, at = data[1] & 0x7F, 2
        if size == 126:
            size, at = int.from_bytes(data[2:4], "big"), 4
        elif size == 127:
            size, at = int.from_bytes(data[2:10], "big"), 10
        mask, at = (data[at : at + 4], at + 4) if data[1] & 0x80 else (bytes(4), at)
        body = data[at : at + size]
        found.append((data[0], bytes(b ^ mask[i % 4] for i, b in enumerate(body))))
        data = data[at + size :]
    return found


@given(
    payloads=st.lists(st.binary(max_size=300), max_size=4), cut=st.integers(1, 40),
    mask=st.just(b"") | st.binary(min_size=4, max_size=4),
)  # fmt: skip
def test_messages_in_fragments_are_the_same_messages(payloads: list[bytes], cut: int, mask: bytes) -> None:
    fragments = link.Fragments(16)
    sent = b"GET / HTTP/1.1\r\n\r\n" + b"".join(frame(each, 0x81, mask) for each in payloads)

    got = b"".join(fragments.feed(sent[i : i + cut]) for i in range(0, len(sent), cut))

    head, _, rest = got.partition(b"\r\n\r\n")
    assert head == b"GET / HTTP/1.1"
    messages: list[bytes] = []
    is_open = False
    for first, payload in read(rest):
        assert len(payload) <= 16
        assert (first & 0x0F) == (0 if is_open else 1)
        messages = [*messages[:-1], messages[-1] + payload] if is_open else [*messages, payload]
        is_open = not first & 0x80
    assert (messages, is_open) == (payloads, False)


@pytest.mark.parametrize("opcode", [0x88, 0x89, 0x8A])
def test_control_frames_are_left_alone(opcode: int) -> None:
    fragments = link.Fragments(4)
    fragments.feed(b"\r\n\r\n")

    assert fragments.feed(frame(b"0123456789", opcode)) == frame(b"0123456789", opcode)
