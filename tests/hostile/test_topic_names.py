"""Names of topics that are long, lead out or look alike are no live maps."""

from __future__ import annotations

import pytest

from rse_pf.errors import BadRequest
from rse_pf.wire.live_map import map_of_topic

NAMES = {
    "nothing": "",
    "a slash": "/",
    "two slashes": "//scan",
    "a slash inside": "/a//b",
    "a slash at the end": "/a/",
    "the folder above": "../a",
    "a folder above inside": "/a/../b",
    "at the end": "/a/..",
    "the same": "/a/./b",
    "a long segment": "/a/" + "b" * 129,
    "many segments": "/a" * 18,
    "a long name": "a" * 256,
    "NUL": "/a\x00b",
    "a line": "/a\nb",
    "a line at the end": "/a\n",
    "an escape sequence": "/a\x1b[2Jb",
    "delete": "/a\x7f",
    "from right to left": "/a\u202eb",
    "invisible": "/a\u200bb",
    "another alphabet": "/s\u0441an",
    "wide": "/\uff53can",
    "combining": "/e\u0301",
    "composed": "/\xe9",
    "a line of Unicode": "/a\u2028b",
    "a digit first": "/1scan",
    "a star": "/*",
    "a wildcard of levels": "/scan/#",
    "a wildcard of one": "/+/scan",
    "a pattern": "/s?an",
    "brackets": "/[a]",
    "a percent": "/a%2fb",
    "a backslash": "/a\\b",
    "a space": "/a b",
    "a colon": "/other:chat",
    "a tenant": "/@other/chat",
}


@pytest.mark.parametrize("name", NAMES)
def test_no_hostile_name_is_a_live_map(name: str) -> None:
    for topic in (NAMES[name], f"live/{NAMES[name]}"):
        with pytest.raises(BadRequest, match="no topic") as raised:
            map_of_topic(topic)
        assert len(raised.value.message) < 300


@pytest.mark.parametrize(
    "topic", ["m", "live/M", "live/m\n", "live/m ", "live/-m", "LIVE/m", "live/live/m", "/live/m"]
)
def test_a_name_that_is_nearly_that_of_a_live_map_is_none(topic: str) -> None:
    with pytest.raises(BadRequest, match="no topic"):
        map_of_topic(topic)
