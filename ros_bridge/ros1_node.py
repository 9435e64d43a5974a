"""The bridge as a node of ROS 1: rospy transports messages as bytes, and `ros_bridge.incoming` decodes them.

When the ROS master is restarted, the registrations of all topics are lost, while existing connections
continue. `_Master` checks every 2 s whether the master knows this node, and registers the node again if it
does not.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import hashlib
import importlib
import importlib.util
import sys
import threading
import time
import xmlrpc.client
from collections.abc import Callable, Coroutine
from io import BytesIO
from pathlib import Path
from typing import Any

from client_sdk.bags.message_maker import MessageMaker
from ros_bridge.bridge import Bridge, CallReply, connected_bridge
from ros_bridge.incoming import Role
from ros_bridge.options import BridgeOptions
from ros_bridge.outgoing import Message, advertised
from ros_bridge.shell import end_by_signal, queue_of, run_until, taken
from rse_pf.errors import CommandFailed, UsageError
from rse_pf.terminal import show

__all__ = ["CALL_REPLY", "CALL_REQUEST", "run_ros1_node"]

# Folder in which Debian installs rospy for the Python of the system.
_DEBIAN = Path("/usr/lib/python3/dist-packages")
# Time between two checks of the registration at the ROS master, in seconds.
_MASTER_EVERY_S = 2.0
# Time limit of a request to the ROS master, in seconds.
_MASTER_S = 1.0
# Longest wait of a ROS service for its result, in seconds.
_CALL_S = 30.0
CALL_REQUEST = "string service\nstring payload"
"""Definition of the request of the ROS service ``~call``, as in ``Call.srv``."""
CALL_REPLY = "bool ok\nstring reply\nstring code\nstring message"
"""Definition of the reply of the ROS service ``~call``, as in ``Call.srv``."""


def run_ros1_node(arguments: list[str], options: dict[str, Any]) -> int:
    """Run the node until a signal or rospy ends it; return the exit code.

    *arguments* are those of rospy, such as remappings; *options* override the private parameters of the node.

    Raises:
        UsageError: rospy is not installed, there is no master, or a parameter cannot be used.
        RsePfError: The platform refuses the robot.
    """
    BridgeOptions.of(options)  # raises the error of a wrong option before the wait for a ROS master
    rospy = _import_rospy()
    _wait_for_master()
    rospy.init_node("rse_pf_bridge", argv=arguments, disable_signals=True)
    namespace = str(rospy.get_namespace()).strip("/")
    parameters = {"namespace": namespace, **(rospy.get_param("~", {}) or {}), **options}
    node = _Node(rospy, BridgeOptions.of(parameters))
    try:
        return asyncio.run(node.run())
    finally:
        rospy.signal_shutdown("the bridge has stopped")


class _Node:
    """The publishers, subscribers and services of one bridge in rospy."""

    def __init__(self, rospy: Any, options: BridgeOptions) -> None:
        self._rospy, self._options = rospy, options
        self._maker = MessageMaker(is_ros1=True)
        self._publishers: dict[str, Any] = {}

    async def run(self) -> int:
        """Run the bridge until a signal or a shutdown of rospy; return the exit code 0."""
        loop, ended = asyncio.get_running_loop(), end_by_signal()
        self._rospy.on_shutdown(lambda: _set_in(loop, ended))
        for topic, kind, latched in advertised(self._options):
            self._publishers[topic] = self._rospy.Publisher(
                topic, self._raw(kind), queue_size=10, latch=latched, tcp_nodelay=True
            )
        now_ns = self._now_ns
        async with connected_bridge(self._options, self._publish, is_ros1=True, now_ns=now_ns) as bridge:
            self._subscribe(bridge)
            self._offer(bridge, loop)
            master = _Master(self._rospy)
            watching = threading.Thread(target=master.watch, name="master", daemon=True)
            watching.start()
            try:
                await run_until(bridge, self._options, ended)
            finally:
                master.stop.set()
        return 0

    def _now_ns(self) -> int:
        return int(self._rospy.Time.now().to_nsec())

    def _subscribe(self, bridge: Bridge) -> None:
        for role, topic, kind in taken(self._options):
            self._rospy.Subscriber(
                topic, self._raw(kind), _receiver(bridge, role), queue_size=queue_of(role, self._options),
                buff_size=1 << 24, tcp_nodelay=True,
            )  # fmt: skip

    def _publish(self, message: Message) -> None:
        raw = self._publishers[message.topic].data_class()
        raw._buff = message.data
        self._publishers[message.topic].publish(raw)

    def _raw(self, kind: str) -> type[Any]:
        """Return a rospy message class that holds raw bytes, with name and MD5 sum of the type *kind*."""
        text, md5 = self._maker.types.generate_msgdef(kind, ros_version=1)
        package, _, name = kind.partition("/msg/")
        parts = {"_type": f"{package}/{name}", "_md5sum": md5, "_full_text": text, "_has_header": False}
        return type(f"Raw{name}", (self._rospy.AnyMsg,), {"__slots__": ["_buff"], **parts})

    def _offer(self, bridge: Bridge, loop: asyncio.AbstractEventLoop) -> None:
        """Offer the ROS services of the bridge: ``~call``, and one without a request for each trigger."""

        def wait(work: Any) -> CallReply:
            reply: CallReply = asyncio.run_coroutine_threadsafe(work, loop).result(_CALL_S)
            return reply

        call = _service_class(
            self._rospy, "rse_pf_bridge/Call", CALL_REQUEST, CALL_REPLY, ["string", "string"],
            ["bool", "string", "string", "string"],
        )  # fmt: skip
        trigger = _service_class(
            self._rospy, "std_srvs/Trigger", "", "bool success\nstring message", [], ["bool", "string"]
        )

        def called(request: Any) -> Any:
            reply = wait(bridge.call(*request.values))
            return call._response_class([reply.ok, reply.reply, reply.code, reply.message])

        def triggered(ask: Callable[[], Coroutine[Any, Any, CallReply]], _: Any) -> Any:
            reply = wait(ask())
            return trigger._response_class([reply.ok, reply.reply or f"{reply.code}: {reply.message}"])

        self._rospy.Service("~call", call, called)
        for name, ask in bridge.triggers.items():
            self._rospy.Service(f"~{name}", trigger, functools.partial(triggered, ask))


class _Master:
    """Registers this node again at a ROS master that was restarted, by the XML-RPC interfaces of both."""

    def __init__(self, rospy: Any) -> None:
        self.stop = threading.Event()
        self._rospy = rospy
        self._name = str(rospy.get_name())

    def watch(self) -> None:
        """Check the registration every 2 s until `stop` is set; an unreachable master is ignored."""
        while not self.stop.wait(_MASTER_EVERY_S):
            with contextlib.suppress(OSError, xmlrpc.client.Error):
                self._register_if_unknown()

    def _register_if_unknown(self) -> None:
        rosgraph = importlib.import_module("rosgraph")
        master: Any = xmlrpc.client.ServerProxy(rosgraph.get_master_uri(), transport=_TimedTransport())
        code, _, _ = master.lookupNode(self._name, self._name)
        if code == 1:
            return
        core: Any = importlib.import_module("rospy.core")
        topics: Any = importlib.import_module("rospy.impl.registration").get_topic_manager()
        services: Any = importlib.import_module("rospy.impl.registration").get_service_manager()
        uri = core.get_node_uri()
        own: Any = xmlrpc.client.ServerProxy(uri, transport=_TimedTransport())
        for topic, kind in topics.get_publications():
            master.registerPublisher(self._name, topic, kind, uri)
        for topic, kind in topics.get_subscriptions():
            code, _, publishers = master.registerSubscriber(self._name, topic, kind, uri)
            if code == 1:
                own.publisherUpdate("/master", topic, publishers)
        for service, address in services.get_services():
            master.registerService(self._name, service, address, uri)
        show("the ROS master did not know this node, and has it registered again")


class _TimedTransport(xmlrpc.client.Transport):
    """An XML-RPC transport whose requests fail after 1 s, so that a master that hangs does not block."""

    def make_connection(self, host: Any) -> Any:
        connection = super().make_connection(host)
        connection.timeout = _MASTER_S
        return connection


def _receiver(bridge: Bridge, role: Role) -> Callable[[Any], None]:
    def receive(message: Any) -> None:
        bridge.receive(role, message._buff)

    return receive


def _service_class(
    rospy: Any, kind: str, request: str, reply: str, takes: list[str], gives: list[str]
) -> type[Any]:
    """Return a service class for rospy that needs no package with generated messages.

    Args:
        rospy: The module.
        kind: Name of the service type, such as ``std_srvs/Trigger``.
        request: Definition of the request, from which the MD5 sum is computed.
        reply: Definition of the reply.
        takes: Types of the request's fields, "bool" or "string".
        gives: Types of the reply's fields.
    """
    md5 = hashlib.md5((request + reply).encode(), usedforsecurity=False).hexdigest()
    name = kind.rpartition("/")[2]

    def message(part: str, kinds: list[str]) -> type[Any]:
        class Fields(rospy.AnyMsg):  # type: ignore[misc]  # rospy has no types
            """A request or reply: ``values`` holds its fields in the order of the definition."""

            __slots__ = ["values"]
            _type, _md5sum, _full_text, _slot_types = kind + part, md5, request or reply, kinds

            def __init__(self, values: Any = ()) -> None:
                super().__init__()
                self.values = list(values)

            def serialize(self, buffer: BytesIO) -> None:
                for each, value in zip(kinds, self.values, strict=True):
                    if each == "bool":
                        buffer.write(bytes([bool(value)]))
                    else:
                        data = str(value).encode()
                        buffer.write(len(data).to_bytes(4, "little") + data)

            def deserialize(self, data: bytes) -> Any:
                place, self.values = 0, []
                for each in kinds:
                    if each == "bool":
                        self.values.append(bool(data[place]))
                        place += 1
                    else:
                        size = int.from_bytes(data[place : place + 4], "little")
                        self.values.append(data[place + 4 : place + 4 + size].decode())
                        place += 4 + size
                return self

        return Fields

    parts = {"_type": kind, "_md5sum": md5, "_request_class": message("Request", takes),
             "_response_class": message("Response", gives)}  # fmt: skip
    return type(name, (), parts)


def _set_in(loop: asyncio.AbstractEventLoop, event: asyncio.Event) -> None:
    with contextlib.suppress(RuntimeError):
        loop.call_soon_threadsafe(event.set)


def _import_rospy() -> Any:
    """Import rospy, if necessary from the packages of Debian's Python, which virtual environments do not see.

    Raises:
        UsageError: rospy cannot be imported.
    """
    if importlib.util.find_spec("rospy") is None and (_DEBIAN / "rospy").is_dir():
        sys.path.append(str(_DEBIAN))
    try:
        rospy = importlib.import_module("rospy")
        importlib.import_module("rospy.service")
        return rospy
    except ImportError as error:
        raise UsageError(
            f"rospy cannot be imported: {error}",
            hint="install the packages that docs/ros.md names, or source the setup.bash of your ROS 1",
        ) from error


def _wait_for_master() -> None:
    rosgraph = importlib.import_module("rosgraph")
    uri = rosgraph.get_master_uri()
    until = time.monotonic() + 10.0
    while not rosgraph.is_master_online():
        if time.monotonic() > until:
            raise CommandFailed(
                f"no ROS master answers at {uri}", hint="start roscore, or set ROS_MASTER_URI"
            )
        time.sleep(0.2)
