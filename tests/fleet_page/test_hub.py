"""The data for browsers is bounded: pages, messages that wait for a slow page, and the content of texts."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncGenerator
from typing import Any

import pytest

from rse_pf.extensions.fleet_page.hub import Hub

ALL = frozenset(("fleet", "event"))


def reported(message: bytes) -> Any:
    return json.loads(message.removeprefix(b"data: "))


async def next_of(messages: AsyncGenerator[bytes, None], count: int) -> list[Any]:
    return [reported(await asyncio.wait_for(messages.__anext__(), 5.0)) for _ in range(count)]


async def test_a_page_that_does_not_read_gets_the_newest_value_only() -> None:
    hub = Hub()
    messages = hub.messages(ALL)
    await messages.__anext__()

    for number in range(10_000):
        hub.put("fleet", "now", {"robots": number})
        hub.append("event", {"number": number})
    rows = await next_of(messages, 2001)
    await messages.aclose()

    assert [each["value"]["number"] for each in rows[:2000]] == list(range(8000, 10_000))
    assert rows[2000] == {"topic": "fleet", "key": "now", "value": {"robots": 9999}}


@pytest.mark.parametrize("name", ["a\n\ndata: {}", "\r\r", "</script>", "\u2028", "event: x\n"])
async def test_no_text_ends_a_message(name: str) -> None:
    hub = Hub()
    hub.append("event", {"text": name})
    messages = hub.messages(ALL)
    await messages.__anext__()
    message = await messages.__anext__()
    await messages.aclose()

    assert message.endswith(b"\n\n")
    assert b"\n" not in message[:-2]
    assert b"\r" not in message
    assert reported(message)["value"]["text"] == name
