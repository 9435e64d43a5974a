"""Select the messages that are recorded, and replace names in them by pseudonyms; tokens are never recorded.

Recorded are the commands of services whose requests have no field for a name, their answers, and the messages
that open and keep a connection.  All others, such as renewals of tokens, updates, and messages that cannot be
decoded, are left out, and so is every message that contains a token or another secret.  If a free text
contains the name of the robot or of its tenant, the message is encoded again with a pseudonym; all other
messages are recorded byte by byte.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import re
import zlib
from collections import OrderedDict
from collections.abc import Iterable
from typing import Any, NamedTuple

import msgspec

from rse_pf.errors import RsePfError
from rse_pf.identity import DEFAULT_TENANT, RobotId
from rse_pf.wire import Codec, Welcome, make_codec
from rse_pf.wire.envelope import peek

__all__ = ["NAME_FREE_SERVICES", "ConnectionRedactor", "Kept", "Pseudonyms"]

NAME_FREE_SERVICES = frozenset({"pnp", "icp"})
"""Services whose requests and replies have no field for a name."""
KEY_BYTES = 32  # smallest size of the key of the pseudonyms
_PSEUDONYM_DIGITS = 8  # number of hex digits of a pseudonym
# Largest number of commands of a connection whose answers are awaited: bounds the memory.
_MAX_OPEN_COMMANDS = 4096
# Types of messages from robots, apart from commands, that are recorded.
_RECORDED_FROM_ROBOT = frozenset({"hello", "ping", "cancel"})
# Types of messages from servers that are recorded although they answer no command.
_RECORDED_FROM_SERVER = frozenset({"move", "pong", "renewed"})
_TEXT_FIELDS = ("trace", "stream", "message", "hint", "what", "reason", "sdk")  # fields with free texts
_VALUE_FIELDS = ("payload", "reply")  # fields with values of a service, in which `PROTOCOL_WORDS` stay
PROTOCOL_WORDS = frozenset({
    "camera", "points_world", "pixels", "options", "depths_m", "depth_noise", "T_camera_world", "inliers",
    "rmse_px", "covariance", "verdict", "reason", "engine", "native", "opencv", "ok", "weak",
    "target", "source", "T_target_source", "overlap", "iterations",
})  # fmt: skip
"""Words of requests and replies that are never replaced in `_VALUE_FIELDS`, even if a robot has such a
name."""
_TOKEN_START = b"eyJ"  # the first bytes of every JSON Web Token
_TOKEN = re.compile(rb"eyJ[A-Za-z0-9_-]{8,}\.[A-Za-z0-9_-]{8,}\.[A-Za-z0-9_-]{8,}")
"""Pattern of a JSON Web Token; a message that contains one is left out."""
_RESULT = re.compile(rb'\{"type":"result","id":([1-9][0-9]{0,15}|0),"reply":')
"""Start of a result in JSON as servers write it, with the id of the command: saves decoding the message."""
# Exceptions of a message that cannot be decoded, which is then left out.
_UNDECODABLE = (msgspec.DecodeError, RecursionError, ValueError, TypeError, RsePfError)


class _Head(msgspec.Struct, frozen=True):
    """The fields of a message that decide whether it is recorded."""

    type: str
    id: int | None = None
    service: str = ""


_json_head = msgspec.json.Decoder(_Head).decode
_binary_head = msgspec.msgpack.Decoder(_Head).decode


class Kept(NamedTuple):
    """A message as it is recorded.

    Attributes:
        data: The encoded message, with pseudonyms for names.
        text: The message before it was deflated; empty if it was not inflated here.
        type: Type of the message, such as ``result``.
        service: Service of the command, or of the command that the message answers; "" if there is none.
    """

    data: bytes
    text: bytes
    type: str
    service: str


class Pseudonyms:
    """Pseudonyms of robots and tenants: the same within one recording, and not invertible without the key."""

    def __init__(self, key: bytes) -> None:
        """Take the random key, which is never recorded."""
        self._key = key

    def robot(self, robot: RobotId) -> str:
        """Return the pseudonym of a robot, ``robot-XXXXXXXX``."""
        return f"robot-{self._digest(robot.folder)}"

    def tenant(self, tenant: str) -> str:
        """Return the pseudonym of a tenant, ``tenant-XXXXXXXX``."""
        return f"tenant-{self._digest(f'tenant {tenant}')}"

    def _digest(self, text: str) -> str:
        return hmac.new(self._key, text.encode(), hashlib.sha256).hexdigest()[:_PSEUDONYM_DIGITS]


class ConnectionRedactor:
    """Select and redact the messages of one connection, which it gets in the order of time.

    ``left_out`` counts the messages that are not recorded.
    """

    def __init__(
        self,
        codec: Codec,
        robot: RobotId,
        pseudonyms: Pseudonyms,
        *,
        max_inflated_bytes: int,
        secrets: Iterable[str] = (),
    ) -> None:
        """Prepare to redact.

        Args:
            codec: Codec of the connection.
            robot: The connected robot, whose name and tenant are replaced.
            pseudonyms: The pseudonyms that replace them.
            max_inflated_bytes: Largest size of an inflated message; a larger one is left out.
            secrets: Texts such as the token of the robot; a message that contains one is left out.
        """
        self.robot = pseudonyms.robot(robot)
        self.tenant = pseudonyms.tenant(robot.tenant)
        self.left_out = 0
        self._codec = codec
        self._max_bytes = max_inflated_bytes
        self._inflates, self._is_text = codec.name == "zlib", codec.name != "bin"
        self._text_codec = make_codec("json") if self._inflates else codec
        self._head = _binary_head if codec.name == "bin" else _json_head
        names = {robot.name: self.robot}
        if robot.tenant != DEFAULT_TENANT:
            names[robot.tenant] = self.tenant
        names.pop("", None)
        self._names = names
        longest_first = sorted(names, key=len, reverse=True)
        self._in_text = re.compile(_either(longest_first)) if names else None
        self._forms = [form.encode() for form in {form for name in names for form in _spellings(name)}]
        self._secrets = [secret.encode() for secret in secrets if secret]
        self._marks = (_TOKEN_START, *self._secrets, *self._forms)
        self._open: OrderedDict[int, str] = OrderedDict()

    def up(self, data: bytes) -> Kept | None:
        """Return a message of the robot as it is recorded; None if it is left out."""
        try:
            text = self._inflate(data)
            message = peek(self._text_codec, text)
            if message is not None:
                kind, identity, service = "command", message.id, message.service
            else:
                head = self._head(text)
                kind, identity, service = head.type, head.id or 0, head.service
            if kind == "command" and service in NAME_FREE_SERVICES:
                self._remember(identity, service)
            elif kind not in _RECORDED_FROM_ROBOT:
                return self._leave_out()
            stored = self._without_names(data, text, kind, service, from_robot=True)
        except _UNDECODABLE:
            return self._leave_out()
        return stored or self._leave_out()

    def decoded_command(self, identity: int, words: bytes, data: bytes) -> Kept | None:
        """Return a `pnp` command, whose texts the server has decoded, as it is recorded; None if left out.

        Args:
            identity: Id of the command.
            words: All free texts of the command; the rest of it is numbers in known fields.
            data: The message; it is inflated only if the texts may contain a name or a token.
        """
        text = words if self._is_text else words + data
        if self._is_clean(text):
            self._remember(identity, "pnp")
            return Kept(data, b"", "command", "pnp")
        return self.up(data)

    def answer_with_pose(self, identity: int, data: bytes) -> Kept | None:
        """Return the answer to the command *identity*, which contains no texts of a robot, unchanged.

        None if that command was not recorded.
        """
        service = self._open.pop(identity, "")
        return Kept(data, b"", "result", service) if service else self._leave_out()

    def down(self, data: bytes) -> Kept | None:
        """Return a message of the server as it is recorded; None if it is left out."""
        try:
            text = self._inflate(data)
            match = _RESULT.match(text) if self._is_text else None
            head = self._head(text) if match is None else _Head("result", int(match[1]))
            service = ""
            if head.type == "welcome":
                return self._welcome(data)
            if head.type in ("result", "progress") or (head.type == "failure" and head.id is not None):
                service = self._open.get(head.id or 0, "")
                if not service:
                    return self._leave_out()
                if head.type != "progress":
                    del self._open[head.id or 0]
            elif head.type not in _RECORDED_FROM_SERVER and head.type != "failure":
                return self._leave_out()
            stored = self._without_names(data, text, head.type, service, from_robot=False)
        except _UNDECODABLE:
            return self._leave_out()
        return stored or self._leave_out()

    def _leave_out(self) -> Kept | None:
        self.left_out += 1
        return None

    def _remember(self, identity: int, service: str) -> None:
        self._open[identity] = service
        if len(self._open) > _MAX_OPEN_COMMANDS:  # the robot exceeds the limits of the protocol
            self._open.popitem(last=False)

    def _inflate(self, data: bytes) -> bytes:
        """Inflate a message of the codec ``zlib``; return others unchanged.

        Raises ValueError if the message is malformed, or larger than the limit.
        """
        if not self._inflates:
            return data
        stream = zlib.decompressobj()
        try:
            text = stream.decompress(data, self._max_bytes)
        except zlib.error as error:
            raise ValueError("not deflated") from error
        if not stream.eof or stream.unused_data:
            raise ValueError("longer than a message may be")
        return text

    def _without_names(
        self, data: bytes, text: bytes, kind: str, service: str, *, from_robot: bool
    ) -> Kept | None:
        if self._is_clean(text):
            return Kept(data, text, kind, service)
        if any(secret in text for secret in self._secrets):
            return None
        if _TOKEN.search(text) is not None:
            return None
        decode = self._codec.decode_from_robot if from_robot else self._codec.decode_from_server
        message: Any = decode(data)
        changes = {}
        for name in (*_TEXT_FIELDS, *_VALUE_FIELDS):
            before = getattr(message, name, None)
            after = self._replace(before, PROTOCOL_WORDS if name in _VALUE_FIELDS else frozenset())
            if after is not before:
                changes[name] = after
        if not changes:  # the match was a part of a number or of a word of the protocol
            return Kept(data, text, kind, service)
        changed = self._codec.encode(msgspec.structs.replace(message, **changes))
        return Kept(changed, self._inflate(changed), kind, service)

    def _replace(self, value: Any, spared: frozenset[str]) -> Any:
        """Replace names by pseudonyms in the strings of *value*, but not in strings of *spared*.

        The same object is returned if nothing was replaced.
        """
        if isinstance(value, str):
            if self._in_text is None or value in spared:
                return value
            text = self._in_text.sub(self._pseudonym, value)
            return value if text == value else text
        if isinstance(value, dict):
            items = [(self._replace(key, spared), self._replace(item, spared)) for key, item in value.items()]
            is_same = all(a is c and b is d for (a, b), (c, d) in zip(value.items(), items, strict=True))
            return value if is_same else dict(items)
        if isinstance(value, list):
            parts = [self._replace(item, spared) for item in value]
            return value if all(a is b for a, b in zip(value, parts, strict=True)) else parts
        return value

    def _pseudonym(self, match: re.Match[str]) -> str:
        return self._names[match.group()]

    def _is_clean(self, text: bytes) -> bool:
        """Return whether *text* contains neither the start of a token, nor a secret, nor a name."""
        for mark in self._marks:  # noqa: SIM110  a generator costs more than the search
            if mark in text:
                return False
        return True

    def _welcome(self, data: bytes) -> Kept | None:
        message = self._codec.decode_from_server(data)
        if not isinstance(message, Welcome):
            return None
        # Scopes may name maps and services of the tenant.
        tenant = None if message.tenant is None else self.tenant
        changed = self._codec.encode(
            msgspec.structs.replace(message, robot=self.robot, tenant=tenant, scopes=())
        )
        return Kept(changed, self._inflate(changed), "welcome", "")


def _spellings(name: str) -> set[str]:
    """Return the spellings of *name* in MessagePack and in JSON, with and without escapes."""
    return {name, json.dumps(name)[1:-1], json.dumps(name, ensure_ascii=False)[1:-1]}


def _either(names: Iterable[str]) -> str:
    """Return a regular expression that matches any of *names* as a whole word."""
    return f"(?<![A-Za-z0-9_])(?:{'|'.join(map(re.escape, names))})(?![A-Za-z0-9_])"
