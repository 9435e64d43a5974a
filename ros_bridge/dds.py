"""The bridge over DDS without any ROS: it reads and writes the topics of ROS 2 robots by Cyclone DDS.

A topic ``/a/b`` is ``rt/a/b`` in DDS, and a type ``sensor_msgs/msg/Image`` is
``sensor_msgs::msg::dds_::Image_``.
The definitions are those of `client_sdk.bags.message_types`, so the bytes are those of a ROS 2 bag.

Not yet run against a ROS 2 node: there was none where this was written.
"""

from __future__ import annotations

import asyncio
import dataclasses
import functools
import importlib
import threading
import types as python_types
from collections.abc import Callable
from typing import Any

from client_sdk.bags.message_maker import MessageMaker
from ros_bridge.bridge import connected_bridge
from ros_bridge.options import BridgeOptions
from ros_bridge.outgoing import Message, advertised
from ros_bridge.shell import end_by_signal, queue_of, run_until, taken
from rse_pf.errors import MissingExtra

__all__ = ["DdsTopics", "run_dds"]

_BASE, _NAME, _ARRAY, _SEQUENCE = 1, 2, 3, 4
"""Kinds of a field in the definitions of `rosbags`."""
_NUMBERS = {
    "bool": bool, "string": str, "byte": "uint8", "octet": "uint8", "char": "uint8",
    "float32": "float32", "float64": "float64",
    **{f"{sign}int{bits}": f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)},
}  # fmt: skip
_WAIT_S = 0.2


class DdsTopics:
    """The topics of one participant: bytes in CDR, with their header of four bytes, in and out."""

    def __init__(self, domain: int = 0) -> None:
        """Join a DDS domain, ``ROS_DOMAIN_ID`` of the robots.

        Raises:
            MissingExtra: ``cyclonedds`` is not installed.
        """
        try:
            self._idl = importlib.import_module("cyclonedds.idl")
            self._idl_types = importlib.import_module("cyclonedds.idl.types")
            self._core = importlib.import_module("cyclonedds.core")
            participants = importlib.import_module("cyclonedds.domain")
            self._topics = importlib.import_module("cyclonedds.topic")
            self._publishing = importlib.import_module("cyclonedds.pub")
            self._subscribing = importlib.import_module("cyclonedds.sub")
        except ImportError as error:
            raise MissingExtra("cyclonedds", "ros-dds") from error
        self._maker = MessageMaker(is_ros1=False)
        self._participant = participants.DomainParticipant(domain)
        self._classes: dict[str, Any] = {}
        self._raw: dict[str, Any] = {}
        self._writers: dict[str, tuple[Any, Any]] = {}
        self._threads: list[threading.Thread] = []
        self._ended = threading.Event()

    def advertise(self, topic: str, kind: str, *, latched: bool = False) -> None:
        """Begin to publish a topic; *latched*: late readers get the last message, too."""
        made = self._raw_class(kind)
        writer = self._publishing.DataWriter(
            self._participant, self._topics.Topic(self._participant, f"rt{topic}", made),
            qos=self._quality(reliable=True, kept=latched, depth=1 if latched else 10),
        )  # fmt: skip
        self._writers[topic] = (writer, made)

    def publish(self, topic: str, data: bytes) -> None:
        """Publish a message of an advertised topic."""
        writer, made = self._writers[topic]
        writer.write(made.deserialize(data))  # which only wraps the bytes

    def subscribe(self, topic: str, kind: str, receive: Callable[[bytes], None], *, depth: int = 5) -> None:
        """Call *receive* with each message of a topic, in a thread of its own, until `close`."""
        reader = self._subscribing.DataReader(
            self._participant, self._topics.Topic(self._participant, f"rt{topic}", self._raw_class(kind)),
            qos=self._quality(reliable=False, kept=False, depth=depth),
        )  # fmt: skip

        def read() -> None:
            waitset = self._core.WaitSet(self._participant)
            waitset.attach(self._core.ReadCondition(reader, self._core.ViewState.Any))
            while not self._ended.is_set():
                waitset.wait(round(_WAIT_S * 1e9))
                for message in reader.take_iter(condition=None, timeout=1):
                    receive(message.serialize())

        thread = threading.Thread(target=read, name=topic, daemon=True)
        thread.start()
        self._threads.append(thread)

    def close(self) -> None:
        """End all readers."""
        self._ended.set()
        for thread in self._threads:
            thread.join()

    def class_of(self, kind: str) -> Any:
        """Return the class of Cyclone DDS for a type such as ``sensor_msgs/msg/Image``."""
        if kind not in self._classes:
            self._classes[kind] = self._make(kind)
        return self._classes[kind]

    def _make(self, kind: str) -> Any:
        package, _, name = kind.partition("/msg/")
        _, described = self._maker.types.fielddefs[kind]
        fields = {field: self._field(field_type) for field, field_type in described}

        def fill(namespace: dict[str, Any]) -> None:
            namespace["__annotations__"] = fields
            namespace["__module__"] = __name__

        made = python_types.new_class(
            f"{name}_", (self._idl.IdlStruct,), {"typename": f"{package}.msg.dds_.{name}_"}, fill
        )
        return dataclasses.dataclass(made)

    def _raw_class(self, kind: str) -> Any:
        """Return a class of the same type whose objects hold nothing but their bytes.

        Cyclone DDS would make a list of numbers of each image, and bytes of that list: 80 ms of CPU for one
        of 640x480 pixels in each direction.
        """

        def serialize(sample: Any, **_: Any) -> bytes:
            data: bytes = sample.raw
            return data

        def deserialize(made: Any, /, data: bytes, **_: Any) -> Any:
            sample = object.__new__(made)
            sample.raw = bytes(data)
            return sample

        if kind not in self._raw:
            made = self._make(kind)
            made.serialize, made.deserialize = serialize, classmethod(deserialize)
            self._raw[kind] = made
        return self._raw[kind]

    def _field(self, described: tuple[int, Any]) -> Any:
        kind, what = int(described[0]), described[1]
        if kind == _BASE:
            number_type = _NUMBERS[what[0]]
            return getattr(self._idl_types, number_type) if isinstance(number_type, str) else number_type
        if kind == _NAME:
            return self.class_of(what)
        inner = self._field(what[0])
        return self._idl_types.array[inner, what[1]] if kind == _ARRAY else self._idl_types.sequence[inner]

    def _quality(self, *, reliable: bool, kept: bool, depth: int) -> Any:
        qos: Any = importlib.import_module("cyclonedds.qos")
        policy = qos.Policy
        return qos.Qos(
            policy.Reliability.Reliable(100_000_000) if reliable else policy.Reliability.BestEffort,
            policy.Durability.TransientLocal if kept else policy.Durability.Volatile,
            policy.History.KeepLast(depth),
        )


def run_dds(options: dict[str, Any]) -> int:
    """Bridge until a signal; the exit code is 0.

    Raises:
        MissingExtra: ``cyclonedds`` is not installed.
        UsageError: An option cannot be used.
        RsePfError: The platform refuses the robot.
    """
    return asyncio.run(_run(BridgeOptions.of(options)))


async def _run(options: BridgeOptions) -> int:
    ended = end_by_signal()
    topics = DdsTopics(options.dds_domain)
    for topic, kind, latched in advertised(options):
        topics.advertise(topic, kind, latched=latched)

    def publish(message: Message) -> None:
        topics.publish(message.topic, message.data)

    try:
        async with connected_bridge(options, publish, is_ros1=False) as bridge:
            for role, topic, kind in taken(options):
                receive = functools.partial(bridge.receive, role)
                topics.subscribe(topic, kind, receive, depth=queue_of(role, options))
            await run_until(bridge, options, ended)
    finally:
        topics.close()
    return 0
