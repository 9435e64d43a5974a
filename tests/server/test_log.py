"""The log has one JSON object in each line, whatever a robot sends."""

from __future__ import annotations

import json
import os
import unicodedata

from hypothesis import given
from hypothesis import strategies as st

from rse_pf.server.log import JsonLog


def written(*events: tuple[str, str, dict], level: str = "info") -> list[str]:
    reading, writing = os.pipe()
    log = JsonLog(level=level, server="s-1", wall_clock=lambda: 5.0, fd=writing).start()
    for method, event, fields in events:
        getattr(log, method)(event, **fields)
    log.close(5.0)
    os.close(writing)
    with os.fdopen(reading, "r", newline="\n") as lines:
        return lines.read().split("\n")[:-1]


@given(hostile=st.text(max_size=400))
def test_a_hostile_string_stays_in_one_line_of_bounded_length(hostile):
    (line,) = written(("info", "command", {"trace": hostile}))

    assert json.loads(line)["trace"] == hostile[:256]
    assert not any(ord(letter) < 32 for letter in line)


def test_no_byte_of_a_name_is_obeyed_by_a_terminal_that_shows_the_log():
    hostile = "r\x1b[2J\x7f\x9b31m\u202e\u200b\u2028é厨\ud800"

    (line,) = written(("info", "join", {"robot": hostile}))

    assert json.loads(line)["robot"] == hostile
    assert [letter for letter in line if unicodedata.category(letter)[0] == "C"] == []
    (plain,) = written(("info", "join", {"robot": "é厨"}))
    assert "é厨" in plain
