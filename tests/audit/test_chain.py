"""The chain: what is bounded and hidden in an entry, and that every way to tamper with a log is named."""

from __future__ import annotations

import json
import math
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rse_pf.audit.chain import (
    GENESIS,
    Chain,
    Entry,
    Head,
    Note,
    RefusalLimiter,
    Value,
    line_of,
    next_entry,
    next_line,
    parse_head,
)

A_TOKEN = "eyJhbGciOiJFZERTQSJ9.eyJzdWIiOiJyb2JvdC0xIn0.c2lnbmF0dXJl"

values = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=400)


def log_of(n: int) -> list[bytes]:
    head, lines = GENESIS, []
    for number in range(n):
        entry = next_entry(
            head,
            Note(
                time=1e9 + number, actor="server-1", action="auth.accepted", subject=f"robot-{number}",
                detail={"source": "10.0.0.7", "n": number, "ok": True},
            ),
        )  # fmt: skip
        head = entry.head
        lines.append(line_of(entry))
    return lines


def first_wrong(lines: list[bytes]) -> tuple[int, str] | None:
    """Return the row of the first line that is wrong, and what is said of it."""
    chain = Chain()
    for row, line in enumerate(lines):
        found = chain.add(line)
        if isinstance(found, str):
            return row, found
    return None


def test_an_unchanged_log_is_intact():
    assert first_wrong(log_of(20)) is None


def test_any_flipped_bit_is_found_in_its_own_line():
    lines = log_of(3)
    for at in range(len(lines[1]) - 1):
        for bit in range(8):
            changed = bytearray(lines[1])
            changed[at] ^= 1 << bit
            found = first_wrong([lines[0], bytes(changed), lines[2]])
            assert found is not None
            assert found[0] == 1, (at, bit, found)


def forged(before: bytes) -> bytes:
    """Return an entry that fits behind *before*."""
    entry = json.loads(before)
    note = Note(time=1.0, actor="nobody", action="token.revoked")
    return line_of(next_entry(Head(entry["seq"], entry["hash"]), note))


@pytest.mark.parametrize(
    ("tamper", "row", "why"),
    [
        (lambda a, b, c, d: [a, b, d], 2, "entry 3 is missing or was changed: entry 4 is in its place"),
        (lambda a, b, c, d: [a, b, d, c], 2, "entry 3 is missing or was changed: entry 4 is in its place"),
        (lambda a, b, c, d: [a, b, forged(b), c, d], 3, "entry 4 is missing or was changed"),
        (lambda a, b, c, d: [a, forged(a), c, d], 2, "entry 3 is missing or was changed"),
        (lambda a, b, c, d: [json.dumps(json.loads(a)).encode() + b"\n", b], 0, "entry 1 was changed"),
    ],
    ids=["removed", "swapped", "inserted", "changed and hashed anew", "written in another way"],
)
def test_tampering_is_found_in_the_first_line_that_does_not_continue_the_chain(
    tamper: Callable[..., list[bytes]], row: int, why: str
):
    found = first_wrong(tamper(*log_of(4))) or (-1, "")

    assert found[0] == row
    assert found[1].startswith(why)


@pytest.mark.parametrize("line", [b"\n", b"{}\n", b"[]\n", b"\xff\n", b'{"seq":1}\n', b"[" * 5000 + b"\n"])
def test_what_is_no_entry_is_said_to_be_none(line: bytes):
    assert first_wrong([line]) == (0, "entry 1 is not readable: the line was changed")


@given(
    actor=st.text(max_size=300),
    action=st.text(max_size=300),
    subject=st.text(max_size=300),
    detail=st.dictionaries(st.text(max_size=300), values, max_size=80),
    time=st.floats(0, 1e11),
)
def test_whatever_is_noted_becomes_a_bounded_line_that_reads_back(actor, action, subject, detail, time):
    entry = next_entry(GENESIS, Note(time=time, actor=actor, action=action, subject=subject, detail=detail))

    assert Chain().add(line_of(entry)) == entry
    assert len(line_of(entry)) < 1 << 18


def test_lone_surrogates_and_numbers_that_json_lacks_are_written_readably():
    detail = {"a": "\ud800", "b": math.inf, "c": math.nan, "d": 2**80}
    entry = next_entry(GENESIS, Note(time=1.0, actor="s", action="x", detail=detail))

    assert isinstance(Chain().add(line_of(entry)), Entry)


def test_a_token_never_reaches_the_log():
    note = Note(
        time=1.0, actor=A_TOKEN, action=f"x {A_TOKEN}", subject=f"Bearer {A_TOKEN}",
        detail={"reason": f"bad: {A_TOKEN}", A_TOKEN: 1},
    )  # fmt: skip

    line = line_of(next_entry(GENESIS, note)).decode()

    assert "eyJ" not in line
    assert line.count("(a token)") == 5


def test_a_head_has_a_string_form_that_can_be_stored_elsewhere():
    head = next_entry(GENESIS, Note(time=1.0, actor="s", action="x")).head

    assert parse_head(str(head)) == head
    assert parse_head("17:xyz") is None
    assert parse_head(f"-1:{'0' * 64}") is None


def test_a_flood_of_refusals_is_counted_and_not_written():
    refusals = RefusalLimiter(per_s=2.0, burst=10.0)

    written = sum(refusals.take("bad-signature", 100.0 + row / 1000) for row in range(5000))

    assert written == 10 + 2 * 5 - 1
    assert refusals.summary() == {"bad-signature": 5000 - written}
    assert refusals.summary() == {}


@pytest.mark.parametrize(
    "detail", [{}, {"z": 1, "a": "ü\n", "previous": "x", "hash": None}, {f"d{n}": n / 7 for n in range(70)}]
)
def test_the_line_of_a_note_is_that_of_its_entry_and_continues_the_chain(
    detail: dict[str, Value],
) -> None:
    note = Note(time=1.23456, actor="a", action="b", subject='"previous":"', detail=detail)

    head, line = next_line(GENESIS, note)

    entry = next_entry(GENESIS, note)
    assert (head, line) == (entry.head, line_of(entry))
    canonical = json.dumps(json.loads(line), sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    assert line == canonical.encode() + b"\n"
    assert Chain().add(line) == entry
