"""The events of a local platform: the sentence, the group (filter of the page) and the log level of each.

Events come from the control plane, from backend servers and from map servers.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rse_pf.identity import DEFAULT_TENANT

__all__ = ["EVENTS", "PLATFORM", "event_sentence", "group_of", "level_of"]

PLATFORM = "platform."
"""Beginning of the action of an entry of the audit log that is an event of the control plane."""

# An event whose kind contains one of these words is in the group "trouble".
_TROUBLE = (
    "gone", "failed", "unhealthy", "crash", "silent", "down", "taken", "not-", "lost", "disk-full",
    "disk-low",
)  # fmt: skip
# An event whose kind begins with one of these is in the group "fault".
_FAULT = ("server-killed", "server-paused", "server-resumed", "balancer-killed", "fault")
# Kinds of events in the group "scaling".
_SCALING = frozenset(
    (
        "grow", "shrink", "replace", "drain-start", "drain-over", "roll-settings", "roll-step",
        "roll-stopped", "rebalance", "robot-moved",
    )
)  # fmt: skip


def event_sentence(event: Mapping[str, Any]) -> str:
    """Return *event* as a sentence; a kind without a sentence in `EVENTS` gives its kind and details.

    Robots and maps of another tenant than the default one are named TENANT/NAME.
    """
    kind = str(event.get("event", ""))
    text = EVENTS.get(kind)
    values = {name: _format_value(value) for name, value in event.items()}
    if text is not None:
        if values.get("tenant", DEFAULT_TENANT) != DEFAULT_TENANT:
            named = {name: values[name] for name in ("robot", "map") if name in values}
            values.update({name: f"{values['tenant']}/{value}" for name, value in named.items()})
        return text.format_map(_Missing(values))
    details = [
        f"{name} {value}"
        for name, value in values.items()
        if value and name not in ("event", "time_s", "number")
    ]
    return f"{kind.replace('-', ' ')}: {', '.join(details)}" if details else kind.replace("-", " ")


def group_of(kind: str) -> str:
    """Return the group of events of *kind*, a filter of the Events view.

    The groups are fault, audit, trouble, scaling and other.
    """
    if kind.startswith(_FAULT):
        return "fault"
    if kind.startswith("audit"):
        return "audit"
    if any(word in kind for word in _TROUBLE):
        return "trouble"
    return "scaling" if kind in _SCALING else "other"


def level_of(kind: str) -> str:
    """Return the log level of events of *kind*: "warning" in the groups fault and trouble, else "info"."""
    return "warning" if group_of(kind) in ("fault", "trouble") else "info"


def _format_value(value: Any) -> str:
    if value is None:
        return "unknown"
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


class _Missing(dict[str, str]):
    def __missing__(self, key: str) -> str:
        return "-"


# The sentence for each kind of event; names in braces are members of the event.
EVENTS: Mapping[str, str] = {
    "adopted": "servers of an earlier control plane were adopted: {servers}",
    "balancer-back": "the load balancer is back after {seconds} s",
    "balancer-failed": "the load balancer does not start: {reason}",
    "balancer-gone": "the load balancer ended: {reason}",
    "balancer-killed": "the load balancer was killed",
    "certificate-renewed": "the certificate was renewed; connections stay",
    "control-plane-silent": "the control plane does not answer",
    "crash-loop": "servers end too soon after their start: the next one starts in {wait_s} s",
    "data-server-down": "data server {name} ended ({code})",
    "data-server-failed": "data server {name} does not start: {error}",
    "data-server-silent": "data server {name} does not answer and is killed",
    "data-server-start": "data server {name} starts",
    "data-server-up": "data server {name} is ready (pid {pid})",
    "disk-full": "{reason}",
    "disk-low": "{reason}",
    "disk-ok": "there is space again: {reason}",
    "drain-over": "{server} has left after {seconds} s",
    "drain-start": "{server} drains ({reason}); its robots move",
    "grow": "{servers} more: {reason}",
    "live-aligned": "{robot} is aligned with the live map {map}",
    "live-alignment-lost": "{robot} is no longer aligned with the live map {map}: {reason}",
    "live-map-given-up": "{server} no longer serves the live map {map} ({how})",
    "live-map-lost": "{server} lost the live map {map} to another server: {reason}",
    "live-map-not-optimised": "the live map {map} is less accurate than it could be: {reason}: {fix}",
    "live-map-owned": "{server} serves the live map {map} with {keyframes} keyframes",
    "live-map-published": "version {number} of the live map {map} is published",
    "metrics-port-taken": "port {port} is taken: the metrics have another one",
    "not-written": "something could not be written: {reason}",
    "over": "the control plane has ended",
    "platform-gone": "the platform has ended",
    "platform-ready": "the platform is ready after {seconds} s",
    "rebalance": "{server} asks {robots} of its robots to move",
    "replace": "{server} is replaced by {by}: {reason}",
    "robot-moved": "{robot} moved from {before} to {server}",
    "robot-offline": "{robot} is no longer connected to {server}",
    "robot-online": "{robot} is connected to {server}",
    "roll-settings": "new servers get other settings: {settings}",
    "roll-step": "{server} is replaced ({number} of {of})",
    "roll-stopped": "{server} did not become healthy, so the old servers stay",
    "rosbridge-down": "rosbridge server {name} ended ({code})",
    "rosbridge-failed": "rosbridge server {name} does not start: {error}",
    "rosbridge-silent": "rosbridge server {name} does not answer and is killed",
    "rosbridge-start": "rosbridge server {name} starts",
    "rosbridge-up": "rosbridge server {name} is ready (pid {pid})",
    "server-failed": "{server} did not start: {reason}",
    "server-gone": "{server} ended (exit code {exit_code}){cause}",
    "server-healthy": "{server} is healthy and takes robots",
    "server-killed": "{server} was killed by the operator",
    "server-launched": "{server} starts",
    "server-out": "{server} gets no robots any more",
    "server-paused": "{server} was paused by the operator",
    "server-ready": "{server} is ready (pid {pid})",
    "server-resumed": "{server} goes on",
    "server-unhealthy": "{server} is unhealthy: {reason}",
    "shrink": "{servers} less: {reason}",
    "standby-started": "a warm standby was started",
}
