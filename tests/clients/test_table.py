"""The table of clients: what a cell says, a line for each scenario, and what the link does to messages."""

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
page = module(HERE.parents[1] / "scripts" / "clients_page.py")


def row(client: str, scenario: str, passed: bool | None, skipped: str | None = None) -> dict[str, Any]:
    return {
        "client": client, "scenario": scenario, "run": 1, "passed": passed, "skipped": skipped, "why": "",
        "figures": {"p50_ms": 3.21},
    }  # fmt: skip


def test_a_cell_says_whether_every_run_passed_and_why_there_was_none() -> None:
    rows = [row("a", "pnp", True), row("a", "pnp", False), row("b", "pnp", None, "not claimed")]
    rows += [row("c", "pnp", None, "node is missing"), row("d", "pnp", True), row("d", "stream/move", True)]

    text = page.table({"version": "1", "date": "2026-01-01", "runs": 2, "load_average": 1.0, "rows": rows})

    (line,) = [each for each in text.splitlines() if each.startswith(f"| {page.FEATURES['pnp']} ")]
    assert line.split(" | ")[1:] == ["**failed**", "no", "not run", "yes |"]
    assert text.splitlines()[-1].split(" | ")[1:] == ["", "", "", "3.2 |"]


def test_the_text_between_the_marks_is_replaced_and_nothing_else() -> None:
    before = f"# A\n{page.BEGIN}old\n{page.END}after\n"

    assert page.with_table(before, "new") == f"# A\n{page.BEGIN}\nnew\n{page.END}after\n"
    assert page.BEGIN in page.PAGE.read_text(encoding="utf-8")


def test_every_scenario_of_the_harness_is_a_line_of_the_page() -> None:
    text = (HERE / "scenarios.py").read_text(encoding="utf-8")

    assert [name for name in page.FEATURES if f'@scenario("{name}"' not in text] == []
    assert text.count("\n@scenario(") == len(page.FEATURES)


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
