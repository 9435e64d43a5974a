"""When the web client reconnects while the network is gone: in a page, and in Node."""

from __future__ import annotations

import asyncio
from typing import Any

from tests.client_web.test_failures import printed

FAKES = """
let isThere = true;
const dials = [];
let onDial = () => {};
const seconds = () => performance.now() / 1e3;
/** A WebSocket to a server that welcomes a robot, while the network is there; otherwise *fail* takes it. */
const socketThat = (fail) => class {
  constructor(_, protocols) {
    this.protocol = [protocols].flat()[0];
    this.readyState = 0;
    dials.push(this);
    this.at = seconds();
    onDial();
    if (!isThere) return fail(this);
    queueMicrotask(() => {
      this.readyState = 1;
      this.onopen();
    });
  }
  send(text) {
    const { type, sent_s } = JSON.parse(text);
    const welcome = { type: "welcome", server: "s", limits: { max_message_bytes: 1e5, max_in_flight: 8 } };
    const answer = { hello: welcome, ping: { type: "pong", sent_s, received_s: 1, answered_s: 1 } }[type];
    queueMicrotask(() => this.onmessage({ data: JSON.stringify(answer) }));
  }
  close() {}
};
const failAtOnce = (socket) => queueMicrotask(() => socket.onclose({ code: 1006 }));
const nextDial = (withinS) => new Promise((resolve) => {
  const late = setTimeout(() => resolve(null), withinS * 1e3);
  onDial = () => {
    clearTimeout(late);
    resolve(dials.at(-1).at - dials.at(-2).at);
  };
});
/** Connect, and lose the network. */
const lose = async (fail, options = {}) => {
  await connect("ws://a.invalid/ws", { codec: "json", WebSocket: socketThat(fail), ...options });
  const now = performance.now.bind(performance);
  performance.now = () => now() + 11e3; // it was connected for so long that it counts attempts from 0 again
  isThere = false;
  dials[0].onclose({ code: 1006 });
};
const be = (onLine) =>
  Object.defineProperty(globalThis, "navigator", { value: { onLine }, configurable: true });
"""


def told_by(program: str) -> Any:
    return asyncio.run(printed(FAKES + program))


def test_a_page_without_a_network_dials_ever_more_rarely_and_at_once_when_there_is_one() -> None:
    told = told_by("""
be(false);
globalThis.location = { host: "page.invalid" };
await lose(failAtOnce);
const end = seconds() + 20;
let gap = 0;
while (gap < 1.5 && seconds() < end) gap = await nextDial(20);
isThere = true;
const from = seconds();
const dialled = nextDial(20);
be(true);
await dialled;
say({ gap, dials: dials.length, back_s: seconds() - from });
""")

    assert told["gap"] >= 1.5, told
    assert told["back_s"] < told["gap"], "it did not wait for its next attempt"


def test_an_attempt_that_reached_nobody_ends_the_time_for_which_a_server_is_spared() -> None:
    """A robot whose network went twice within seconds waited as if a server had refused it all the while."""
    told = told_by("""
globalThis.fetch = async () => ({ status: 200, json: async () => ({}) });
let isRefused = true;
await lose((socket) => isRefused && failAtOnce(socket), { connectTimeoutMs: 100 });
await nextDial(5);
isRefused = false;
await nextDial(5);
const now = performance.now.bind(performance);
performance.now = () => now() + 60e3; // the first attempt was refused a minute ago
isRefused = true;
await nextDial(5);
say({ gap: await nextDial(5) });
""")

    assert told["gap"] is not None, told
