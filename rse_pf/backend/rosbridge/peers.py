"""The way of topics between the workers of one server: datagrams that never make a worker wait.

Every worker tells the others which topics it has and which ones its clients want; a message goes only to who
wants its topic.  While another worker takes nothing, the newest message of each topic waits for it.
"""

from __future__ import annotations

import errno
import socket
from asyncio import AbstractEventLoop
from collections.abc import Callable
from dataclasses import dataclass, field

import msgspec

from rse_pf.backend.ports import Log

__all__ = ["NoPeers", "PeerChannels", "WorkerPeers", "peer_channels"]

_BUFFER_BYTES = 1 << 20
_MAX_DATAGRAM_BYTES = 1 << 19
"""The longest message of a robot fits in, with its topic."""
_MAX_READ_AT_ONCE = 16
"""Datagrams that are read in one round of the event loop."""
_RETRY_S = 0.01
_MAX_WAITING = 1000
"""Topics whose newest message waits for one worker."""

Key = tuple[str, str]
PeerChannels = tuple[int, tuple[int, ...]]
"""The descriptor that a worker reads, and those that it writes, by the index of the worker that reads."""


class _State(msgspec.Struct, frozen=True, tag="s", array_like=True):
    sender: int
    tenant: str
    topic: str
    kind: str
    exists: bool
    is_wanted: bool


class _Published(msgspec.Struct, frozen=True, tag="p", array_like=True):
    sender: int
    tenant: str
    topic: str
    data: bytes


_encode = msgspec.msgpack.Encoder().encode
_decode = msgspec.msgpack.Decoder(_State | _Published).decode


def peer_channels(workers: int) -> list[PeerChannels]:
    """Return the channels of each worker, made before they are forked; one worker alone has none."""
    if workers < 2:
        return [(-1, ())] * workers
    pairs = [socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM) for _ in range(workers)]
    for _, write in pairs:
        write.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
    for end in (end for pair in pairs for end in pair):
        end.setblocking(False)
    writes = tuple(write.detach() for _, write in pairs)
    return [(read.detach(), writes) for read, _ in pairs]


class NoPeers:
    """Stands for the other workers where there are none."""

    def tell(self, key: Key, kind: str, *, exists: bool, is_wanted: bool) -> None:
        """Do nothing."""

    def publish(self, key: Key, data: bytes) -> None:
        """Do nothing."""

    def topics(self, tenant: str) -> dict[str, str]:
        """Return nothing."""
        return {}


@dataclass(slots=True)
class _Peer:
    """Another worker, its topics, and the messages that wait for it."""

    channel: socket.socket
    kinds: dict[Key, str] = field(default_factory=dict)
    wants: set[Key] = field(default_factory=set)
    states: dict[Key, bytes] = field(default_factory=dict)
    newest: dict[Key, bytes] = field(default_factory=dict)


class WorkerPeers:
    """The other workers of a server, as one of them sees them."""

    def __init__(
        self,
        channels: PeerChannels,
        index: int,
        *,
        loop: AbstractEventLoop,
        log: Log,
    ) -> None:
        """Take the channels; `begin` reads them.

        Args:
            channels: The channels of this worker, from `peer_channels`.
            index: The number of this worker.
            loop: The event loop of this worker.
            log: The log of this worker.
        """
        read, writes = channels
        self.dropped = 0
        """Messages that newer ones replaced because another worker was slow."""
        self._index = index
        self._loop = loop
        self._log = log
        self._read = socket.socket(fileno=read)
        self._peers = {
            number: _Peer(socket.socket(fileno=fd)) for number, fd in enumerate(writes) if number != index
        }
        self._is_retrying = False

    def begin(self, *, on_message: Callable[[Key, bytes], None], on_wanted: Callable[[Key], None]) -> None:
        """Read what the others send.

        Args:
            on_message: Takes a message and its topic.
            on_wanted: Called when another worker begins to want a topic.
        """
        self._on_message, self._on_wanted = on_message, on_wanted
        self._loop.add_reader(self._read.fileno(), self._on_readable)

    def tell(self, key: Key, kind: str, *, exists: bool, is_wanted: bool) -> None:
        """Report to the others whether a topic exists here, and whether somebody subscribes to it."""
        data = _encode(_State(self._index, *key, kind, exists, is_wanted))
        for peer in self._peers.values():
            if peer.states or not self._send(peer, data):
                peer.states[key] = data  # the newest state of a topic is enough
                self._retry_later()

    def publish(self, key: Key, data: bytes) -> None:
        """Send a message to the others that want the topic."""
        encoded = b""
        for peer in self._peers.values():
            if key not in peer.wants:
                continue
            encoded = encoded or _encode(_Published(self._index, *key, data))
            if not peer.newest and self._send(peer, encoded):
                continue
            self.dropped += key in peer.newest or len(peer.newest) >= _MAX_WAITING
            if key in peer.newest or len(peer.newest) < _MAX_WAITING:
                peer.newest[key] = encoded
            self._retry_later()

    def topics(self, tenant: str) -> dict[str, str]:
        """Return the types of the others' topics of *tenant*, by their names."""
        kinds: dict[str, str] = {}
        for peer in self._peers.values():
            for (owner, name), kind in peer.kinds.items():
                if owner == tenant:
                    kinds[name] = kind or kinds.get(name, "")
        return kinds

    def close(self) -> None:
        """Close the channels of this worker; call it once."""
        self._loop.remove_reader(self._read.fileno())
        for channel in (self._read, *(peer.channel for peer in self._peers.values())):
            channel.close()

    def _send(self, peer: _Peer, data: bytes) -> bool:
        """Send one datagram; return False if the other worker takes none now."""
        try:
            peer.channel.send(data)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.ENOBUFS):
                return False
            # A worker that is gone ends the whole server.
            self._log.warning("topic-not-sent", reason=error.strerror or "")
        return True

    def _retry_later(self) -> None:
        if not self._is_retrying:
            self._is_retrying = True
            self._loop.call_later(_RETRY_S, self._retry)

    def _retry(self) -> None:
        self._is_retrying = False
        for peer in self._peers.values():
            for waiting in (peer.states, peer.newest):
                while waiting:
                    key = next(iter(waiting))
                    if not self._send(peer, waiting[key]):
                        self._retry_later()
                        break
                    del waiting[key]

    def _on_readable(self) -> None:
        for _ in range(_MAX_READ_AT_ONCE):
            try:
                data = self._read.recv(_MAX_DATAGRAM_BYTES)
            except BlockingIOError:
                return
            except OSError as error:
                self._log.error("topics-unread", reason=error.strerror or "")
                self._loop.remove_reader(self._read.fileno())
                return
            self._take(_decode(data))

    def _take(self, message: _State | _Published) -> None:
        key = message.tenant, message.topic
        if isinstance(message, _Published):
            self._on_message(key, message.data)
            return
        peer = self._peers[message.sender]
        if message.exists:
            peer.kinds[key] = message.kind
        else:
            peer.kinds.pop(key, None)
        if not message.is_wanted:
            peer.wants.discard(key)
        elif key not in peer.wants:
            peer.wants.add(key)
            self._on_wanted(key)
