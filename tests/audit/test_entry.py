"""What is bounded and hidden in an entry, and which lines are entries."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from rse_pf.audit.entry import Entry, RefusalLimiter, entry_line, parse_entry

A_TOKEN = "eyJhbGciOiJFZERTQSJ9.eyJzdWIiOiJyb2JvdC0xIn0.c2lnbmF0dXJl"

values = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=400)


@given(
    actor=st.text(max_size=300),
    action=st.text(max_size=300),
    subject=st.text(max_size=300),
    detail=st.dictionaries(st.text(max_size=300), values, max_size=80),
    time=st.floats(0, 1e11),
)
def test_every_entry_is_one_bounded_line_that_reads_back(actor, action, subject, detail, time):
    line = entry_line(Entry(time=time, actor=actor, action=action, subject=subject, detail=detail))

    entry = parse_entry(line)
    assert entry is not None
    assert entry_line(entry) == line
    assert line.count(b"\n") == 1
    assert len(line) < 1 << 18


def test_a_token_never_reaches_the_log():
    entry = Entry(
        time=1.0, actor=A_TOKEN, action=f"x {A_TOKEN}", subject=f"Bearer {A_TOKEN}",
        detail={"reason": f"bad: {A_TOKEN}", A_TOKEN: 1},
    )  # fmt: skip

    line = entry_line(entry).decode()

    assert "eyJ" not in line
    assert line.count("(a token)") == 5


def test_an_entry_with_the_hash_chain_of_version_0_1_is_read():
    line = (
        b'{"action":"auth.accepted","actor":"server-1","detail":{"source":"10.0.0.7"},"hash":"9a","previous":'
        b'"00","seq":1,"subject":"robot-1","time":1000000000.5}\n'
    )

    assert parse_entry(line) == Entry(
        time=1e9 + 0.5, actor="server-1", action="auth.accepted", subject="robot-1",
        detail={"source": "10.0.0.7"},
    )  # fmt: skip


def test_a_flood_of_refusals_is_counted_and_not_written():
    refusals = RefusalLimiter(per_s=2.0, burst=10.0)

    written = sum(refusals.take("bad-signature", 100.0 + row / 1000) for row in range(5000))

    assert written == 10 + 2 * 5 - 1
    assert refusals.summary() == {"bad-signature": 5000 - written}
    assert refusals.summary() == {}
