"""The bridge as a node of ROS 2: rclpy transports messages as CDR bytes, and `incoming` decodes them."""

from __future__ import annotations

import asyncio
import functools
import importlib
import threading
from collections.abc import Callable, Coroutine
from dataclasses import fields
from typing import Any

from ros_bridge.bridge import Bridge, CallReply, connected_bridge
from ros_bridge.options import HELP, BridgeOptions
from ros_bridge.outgoing import Message, advertised
from ros_bridge.shell import end_by_signal, queue_of, run_until, taken
from rse_pf.errors import UsageError
from rse_pf.terminal import show

__all__ = ["publishers_of", "run_ros2_node"]

# Longest wait of a ROS service for its result, in seconds.
_CALL_S = 30.0
# Parameters that every node of ROS 2 has, and that are no options of the bridge.
_OF_ROS = ("use_sim_time", "start_type_description_service")


def run_ros2_node(arguments: list[str], options: dict[str, Any]) -> int:
    """Run the node until a signal ends it; return the exit code.

    *arguments* are those of rclpy, such as ``--ros-args``; *options* override the parameters of the node.

    Raises:
        UsageError: rclpy is not installed, or a parameter cannot be used.
        RsePfError: The platform rejected the robot.
    """
    try:
        rclpy = importlib.import_module("rclpy")
    except ImportError as error:
        raise UsageError(
            f"rclpy cannot be imported: {error}",
            hint="source the setup.bash of your ROS 2, and use its Python, 3.10 or newer",
        ) from error
    signals = importlib.import_module("rclpy.signals").SignalHandlerOptions.NO  # asyncio handles signals
    try:
        rclpy.init(args=["rse-pf-ros", *arguments], signal_handler_options=signals)
        node = rclpy.create_node(
            "rse_pf_bridge", namespace=str(options.get("namespace", "")),
            automatically_declare_parameters_from_overrides=True,
        )  # fmt: skip
    except (RuntimeError, importlib.import_module("rclpy.exceptions").NameValidationException) as error:
        rclpy.try_shutdown()
        raise UsageError(
            f"ROS 2 refuses its arguments: {str(error).splitlines()[0]}",
            hint="--ros-args -p NAME:=VALUE sets a parameter, --params-file FILE all of them",
        ) from error
    try:
        own = {name: parameter.value for name, parameter in node.get_parameters_by_prefix("").items()}
        own = {name: value for name, value in own.items() if name not in _OF_ROS and "." not in name}
        namespace = str(node.get_namespace()).strip("/")
        bridge_options = BridgeOptions.of({"namespace": namespace, **own, **options})
        _declare(node, bridge_options)
        return asyncio.run(_run(rclpy, node, bridge_options))
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def _declare(node: Any, options: BridgeOptions) -> None:
    """Declare each option as a read-only parameter of the node with the value that is used."""
    descriptor = importlib.import_module("rcl_interfaces.msg").ParameterDescriptor
    for each in fields(options):
        if node.has_parameter(each.name):
            node.undeclare_parameter(each.name)
        described = descriptor(description=HELP[each.name], read_only=True)
        node.declare_parameter(each.name, getattr(options, each.name), described, ignore_override=True)


async def _run(rclpy: Any, node: Any, options: BridgeOptions) -> int:
    """Run the bridge until a signal; return the exit code 0."""
    ended = end_by_signal()
    publishers = publishers_of(node, options)

    def publish(message: Message) -> None:
        if message.topic in publishers:
            publishers[message.topic].publish(message.data)

    def now_ns() -> int:
        return int(node.get_clock().now().nanoseconds)

    async with connected_bridge(options, publish, is_ros1=False, now_ns=now_ns) as bridge:
        for role, topic, kind in taken(options):
            receive, is_kept = functools.partial(bridge.receive, role), role == "tf_static"
            quality = _quality(depth=queue_of(role, options), sensor=not is_kept, kept=is_kept)
            try:
                node.create_subscription(_class_of(kind), topic, receive, quality, raw=True)
            except UsageError:
                if role not in ("tf", "tf_static"):  # `publishers_of` has printed what is missing
                    raise
        _offer(node, bridge, asyncio.get_running_loop())
        executor = rclpy.executors.SingleThreadedExecutor()
        executor.add_node(node)
        threading.Thread(target=executor.spin, name="rclpy", daemon=True).start()
        try:
            await run_until(bridge, options, ended)
        finally:
            executor.shutdown()
    return 0


def publishers_of(node: Any, options: BridgeOptions) -> dict[str, Any]:
    """Return a publisher for each topic of the bridge, by the topic's name.

    A topic whose message type is not installed is left out, and a line about it is printed.
    """
    publishers = {}
    for topic, kind, latched in advertised(options):
        try:
            quality = _quality(depth=1 if latched else 10, kept=latched)
            publishers[topic] = node.create_publisher(_class_of(kind), topic, quality)
        except UsageError as error:
            show(f"{topic} is not published: {error.message} ({error.hint})")
    return publishers


def _offer(node: Any, bridge: Bridge, loop: asyncio.AbstractEventLoop) -> None:
    """Offer the ROS services of the bridge that have no request.

    The service ``call`` is not offered: its type would have to be built in a ROS 2 workspace.
    """
    trigger = importlib.import_module("std_srvs.srv").Trigger

    def answered(ask: Callable[[], Coroutine[Any, Any, CallReply]], _: Any, answer: Any) -> Any:
        reply = asyncio.run_coroutine_threadsafe(ask(), loop).result(_CALL_S)
        answer.success, answer.message = reply.ok, reply.reply or f"{reply.code}: {reply.message}"
        return answer

    for name, ask in bridge.triggers.items():
        node.create_service(trigger, f"~/{name}", functools.partial(answered, ask))


def _class_of(kind: str) -> Any:
    """Return the class of the message type *kind*, such as ``sensor_msgs/msg/Image``.

    Raises:
        UsageError: Its package is not installed.
    """
    package, _, name = kind.partition("/msg/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError) as error:
        raise UsageError(
            f"{package} is not installed", hint=f"apt install ros-$ROS_DISTRO-{package.replace('_', '-')}"
        ) from error


def _quality(*, depth: int, sensor: bool = False, kept: bool = False) -> Any:
    """Return a quality of service with a queue of *depth* messages.

    *sensor* makes a subscription best effort, otherwise delivery is reliable; *kept* sends the last messages
    to late subscribers.
    """
    qos = importlib.import_module("rclpy.qos")
    return qos.QoSProfile(
        depth=depth,
        history=qos.HistoryPolicy.KEEP_LAST,
        reliability=qos.ReliabilityPolicy.BEST_EFFORT if sensor else qos.ReliabilityPolicy.RELIABLE,
        durability=qos.DurabilityPolicy.TRANSIENT_LOCAL if kept else qos.DurabilityPolicy.VOLATILE,
    )
