"""Messages within every size limit, built to cost as much as they can (T8)."""

from __future__ import annotations

import pytest

from fuzz.meter import MOST_MS, Meter
from fuzz.samples import DEAR, LONGEST
from rse_pf.errors import ProtocolError
from rse_pf.wire import make_codec

_SLOW_MACHINE = 6.0
_MOST_MIB = 4.0
"""The bar is 2: JSON of 25,000 different keys takes 3.4, of 49,000 words 3.0."""


@pytest.mark.parametrize("name", DEAR)
def test_the_dearest_message_that_we_can_think_of_is_cheap(name: str) -> None:
    speaks, data = DEAR[name]
    assert len(data) <= LONGEST
    meter = Meter()

    for _ in range(2):
        meter.call(make_codec(speaks).decode_from_robot, data, ProtocolError)

    print(name, meter.line())
    assert meter.worst_ms < _SLOW_MACHINE * MOST_MS, meter.line()
    assert meter.worst_mib < _MOST_MIB, meter.line()
