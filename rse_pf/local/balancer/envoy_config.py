"""The configuration of Envoy: its listeners, its clusters, and one endpoint file for each cluster.

There is a listener for robots, and clusters of the backend servers and of the data server; with rosbridge, a
second listener on loopback and a third cluster.  Only the endpoint files change while Envoy runs.  Every
value that differs from Envoy's default has its reason in a comment; most were found by measuring robots while
servers start, drain, stall and crash.
"""

from __future__ import annotations

import socket
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rse_pf.config import PlatformSettings
from rse_pf.config.front_door import (
    BODY_TIMEOUT_S,
    DATA_PATH,
    LOCALISE_PATH,
    MAX_HANDSHAKE_BYTES,
    WRITE_BUFFER_BYTES,
)
from rse_pf.config.resource_names import HEALTH_PATH, READY_PATH, ROBOTS_PATH, ROSBRIDGE_PATH
from rse_pf.local.lan.listener import CERTIFICATE_NAME, LanListener, secret_file
from rse_pf.scaling.health import HEALTHY_CHECKS, LOCAL_INTERVAL_S, LOCAL_TIMEOUT_S

__all__ = [
    "ADMIN_SOCKET", "CLUSTER", "DATA_CLUSTER", "LISTENER", "LOOPBACK_LISTENER", "ROSBRIDGE_CLUSTER", "Target",
    "endpoints", "envoy_config",
]  # fmt: skip

# Envoy's name of the cluster of backend servers, to which robots connect.
CLUSTER = "backend-servers"
# Socket file of Envoy's admin page, in the balancer's folder.  A request to that page can stop Envoy, so it
# is a file that only this user can open, and not a port.
ADMIN_SOCKET = "admin.sock"
# Envoy's name of the cluster of the data server.
DATA_CLUSTER = "data-servers"
# Envoy's name of the cluster of the rosbridge server.
ROSBRIDGE_CLUSTER = "rosbridge-servers"
# Envoy's name of the listener to which robots connect, with TLS if the settings or --lan ask for it.
LISTENER = "front-door"
# Envoy's name of a listener on loopback without TLS: the rosbridge server connects to it for its clients.
LOOPBACK_LISTENER = "loopback"
# Path at which the data server says whether it and its store can serve requests.
_DATA_READY = "/data/readyz"
_TYPES = "type.googleapis.com/envoy"
_LOOPBACK = "127.0.0.1"
# Connections, requests and retries at which Envoy's circuit breakers refuse more: so many that they never act
# before a server's own limit ``serving.max_robots`` does.
_NO_LIMIT = 1_000_000
# Most headers of one request; a request with more is refused.  Robots send about ten.
_MAX_HEADERS = 64
_CIPHERS = (
    "ECDHE-ECDSA-AES128-GCM-SHA256", "ECDHE-RSA-AES128-GCM-SHA256", "ECDHE-ECDSA-AES256-GCM-SHA384",
    "ECDHE-RSA-AES256-GCM-SHA384", "ECDHE-ECDSA-CHACHA20-POLY1305", "ECDHE-RSA-CHACHA20-POLY1305",
)  # fmt: skip
"""Cipher suites that Envoy accepts under TLS 1.2: authenticated encryption with forward secrecy only.

TLS 1.3 has no other suites, so it needs no list.
"""
# Open connections of robots and other clients at the same time; Envoy closes further ones at once.  10,000
# robots and their data requests fit.
_MAX_CONNECTIONS = 12_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """A server to which the load balancer sends connections, on loopback.

    Clients are sent to ``port``, and Envoy's health checks to ``control_port``.
    """

    name: str
    port: int
    control_port: int


def envoy_config(
    settings: PlatformSettings,
    *,
    port: int,
    endpoints_file: Path,
    data_endpoints_file: Path,
    rosbridge_endpoints_file: Path,
    loopback_port: int = 0,
    lan: LanListener | None = None,
) -> dict[str, Any]:
    """Return the configuration with which Envoy is started, as plain JSON values.

    Args:
        settings: Address and certificate of the listener, health checks, time limits of sessions, and
            whether there is a rosbridge server.
        port: Port to which robots connect; 0 takes a free one.
        endpoints_file: Path of the JSON document that `endpoints` returns for the backend servers.  Envoy
            reads the file again when it is replaced by rename; it must never be written in place.
        data_endpoints_file: The same for the data server; without targets ``/data/`` is answered with 503.
        rosbridge_endpoints_file: The same for the rosbridge server; unused unless ``serving.rosbridge``.
        loopback_port: Port of `LOOPBACK_LISTENER`; 0 takes a free one.
        lan: Address and certificate at which robots connect by TLS, in place of ``serving.host`` and
            ``local.certificate``; None uses the settings.
    """
    listeners = [_listener(settings, port, lan)]
    clusters = [
        _cluster(settings, CLUSTER, endpoints_file, READY_PATH, panic_percent=0),
        # 100: requests go to the only data server even while its checks fail.  Its replacement listens on the
        # same port, so a request may succeed although Envoy has not checked the new process yet.
        _cluster(settings, DATA_CLUSTER, data_endpoints_file, _DATA_READY, panic_percent=100),
    ]
    if settings.serving.rosbridge:
        listeners.append(_loopback_listener(settings, loopback_port))
        clusters.append(
            _cluster(settings, ROSBRIDGE_CLUSTER, rosbridge_endpoints_file, HEALTH_PATH, panic_percent=100)
        )
    return {
        "node": {"id": "front-door", "cluster": "rse-pf"},  # Envoy reads endpoint files only if it has a name
        "admin": {"address": {"pipe": {"path": ADMIN_SOCKET, "mode": 0o600}}},
        "overload_manager": _max_connections(_MAX_CONNECTIONS),
        "static_resources": {"listeners": listeners, "clusters": clusters},
    }


def endpoints(targets: Sequence[Target], cluster: str = CLUSTER) -> dict[str, Any]:
    """Return the content of the endpoint file of *cluster*, as plain JSON values.

    Envoy sends clients to ``port`` and health checks to ``control_port`` of each target, on loopback.
    """
    members = [
        {
            "endpoint": {
                "hostname": target.name,
                "address": _address(_LOOPBACK, target.port),
                "health_check_config": {"port_value": target.control_port},
            }
        }
        for target in targets
    ]
    return {
        "resources": [
            {
                "@type": f"{_TYPES}.config.endpoint.v3.ClusterLoadAssignment",
                "cluster_name": cluster,
                "endpoints": [{"lb_endpoints": members}],
            }
        ]
    }


def _listener(settings: PlatformSettings, port: int, lan: LanListener | None) -> dict[str, Any]:
    manager = {
        "@type": f"{_TYPES}.extensions.filters.network.http_connection_manager.v3.HttpConnectionManager",
        "stat_prefix": "robots",
        "codec_type": "HTTP1",
        # No time limits: to Envoy an open WebSocket is one endless request, which only the robot and the
        # server may close.
        "stream_idle_timeout": "0s",
        "request_timeout": "0s",
        "common_http_protocol_options": {
            # Closes a connection that has no request for this long; an open WebSocket counts as a request.
            "idle_timeout": _seconds(settings.session.hello_timeout_s),
            # After this time Envoy closes the connection with its next reply, so that a client without a
            # token cannot keep it by useless requests.  A request that is open then, and so every WebSocket,
            # is not cut.
            "max_connection_duration": _seconds(settings.session.hello_timeout_s),
            "max_headers_count": _MAX_HEADERS,
            "headers_with_underscores_action": "REJECT_REQUEST",
        },
        # How long a connection past max_connection_duration may wait for one more request before it closes.
        "drain_timeout": _seconds(settings.session.hello_timeout_s),
        # 0: Envoy closes a robot's connection at once.  With the default every close takes 1 s, and robots
        # of a server that crashed notice it 1 s later.
        "delayed_close_timeout": "0s",
        "request_headers_timeout": _seconds(settings.session.hello_timeout_s),
        "max_request_headers_kb": MAX_HANDSHAKE_BYTES // 1024,
        # Envoy takes a robot's address from its connection, and not from a header that the robot sent.
        "use_remote_address": True,
        # With suppress_envoy_headers below: no reply says that Envoy runs, or how long a server took.
        "server_header_transformation": "PASS_THROUGH",
        "xff_num_trusted_hops": 0,
        "normalize_path": True,
        "merge_slashes": True,
        "path_with_escaped_slashes_action": "REJECT_REQUEST",
        "upgrade_configs": [{"upgrade_type": "websocket"}],
        "route_config": {"virtual_hosts": [_virtual_host(settings)]},
        "http_filters": [
            {
                "name": "router",
                "typed_config": {
                    "@type": f"{_TYPES}.extensions.filters.http.router.v3.Router",
                    "suppress_envoy_headers": True,
                },
            }
        ],
    }
    return {
        "name": LISTENER,
        "address": _address(settings.serving.host if lan is None else lan.address, port),
        # A taken port is an error: with the default, another Envoy of this user could listen on it, too.
        "enable_reuse_port": False,
        # Envoy accepts one connection and then serves open ones, so a burst of new robots delays nobody.
        "max_connections_to_accept_per_socket_event": 1,
        # Unsent bytes that Envoy and the kernel each keep for a robot that reads slowly: the same limit at
        # which a server counts a client as a slow reader.
        "per_connection_buffer_limit_bytes": WRITE_BUFFER_BYTES,
        "socket_options": [_kernel_buffer(socket.SO_SNDBUF), _unread_timeout(settings)],
        "filter_chains": [{"filters": [{"name": "http", "typed_config": manager}], **_tls(settings, lan)}],
    }


def _loopback_listener(settings: PlatformSettings, port: int) -> dict[str, Any]:
    """Return the listener of robots without TLS, on loopback at *port*, for the rosbridge server."""
    plain = settings.replace(local={"certificate": "", "private_key": ""}, serving={"host": _LOOPBACK})
    return {**_listener(plain, port, None), "name": LOOPBACK_LISTENER}


def _tls(settings: PlatformSettings, lan: LanListener | None) -> dict[str, Any]:
    """Return the field ``transport_socket`` of a listener with TLS 1.2 and 1.3; empty without a certificate.

    The certificate is that of *lan*, else the one that ``local.certificate`` names.
    """
    if lan is None and not settings.local.certificate:
        return {}
    context = {
        "@type": f"{_TYPES}.extensions.transport_sockets.tls.v3.DownstreamTlsContext",
        # No session tickets: with a stolen one, another machine could resume a robot's session for hours; and
        # robots connect so seldom that a full handshake costs little.
        "disable_stateless_session_resumption": True,
        "common_tls_context": {
            "tls_params": {
                "tls_minimum_protocol_version": "TLSv1_2",
                "tls_maximum_protocol_version": "TLSv1_3",
                "cipher_suites": list(_CIPHERS),
            },
            "alpn_protocols": ["http/1.1"],
            **(_certificate_files(settings) if lan is None else _watched_certificate(lan)),
        },
    }
    return {"transport_socket": {"name": "envoy.transport_sockets.tls", "typed_config": context}}


def _certificate_files(settings: PlatformSettings) -> dict[str, Any]:
    local = settings.local
    files = {"certificate_chain": local.certificate, "private_key": local.private_key}
    return {
        "tls_certificates": [{what: {"filename": str(Path(file).absolute())} for what, file in files.items()}]
    }


def _watched_certificate(lan: LanListener) -> dict[str, Any]:
    """Return the part of the TLS context that names the certificate file of *lan*.

    Envoy watches the folder of that file: a renewed certificate serves new connections at once.
    """
    file = secret_file(lan.folder)
    source = {"path": str(file), "watched_directory": {"path": str(file.parent)}}
    config = {"path_config_source": source, "resource_api_version": "V3"}
    return {"tls_certificate_sds_secret_configs": [{"name": CERTIFICATE_NAME, "sds_config": config}]}


def _kernel_buffer(name: int) -> dict[str, Any]:
    """Return Envoy's entry of the socket option *name*, a kernel buffer of `WRITE_BUFFER_BYTES`."""
    return {
        "level": socket.SOL_SOCKET, "name": name, "int_value": WRITE_BUFFER_BYTES, "state": "STATE_PREBIND",
    }  # fmt: skip


def _unread_timeout(settings: PlatformSettings) -> dict[str, Any]:
    """Return the socket option with which Linux closes the connection of a robot that reads nothing.

    Without it Envoy would keep the connection and its unread bytes without end.  The limit is
    twice the sum of ping interval and ping timeout of a session, in ms.
    """
    session = settings.session
    max_ms = int(2e3 * (session.ping_interval_s + session.ping_timeout_s))
    return {
        "level": socket.IPPROTO_TCP,
        "name": socket.TCP_USER_TIMEOUT,
        "int_value": max_ms,
        "state": "STATE_PREBIND",
    }


def _max_connections(most: int) -> dict[str, Any]:
    """Return the overload manager that closes new connections while *most* are open."""
    name = "envoy.resource_monitors.global_downstream_max_connections"
    kind = f"{_TYPES}.extensions.resource_monitors.downstream_connections.v3.DownstreamConnectionsConfig"
    return {
        "resource_monitors": [
            {"name": name, "typed_config": {"@type": kind, "max_active_downstream_connections": str(most)}}
        ]
    }


def _virtual_host(settings: PlatformSettings) -> dict[str, Any]:
    retry = {
        "retry_on": "connect-failure,refused-stream,reset-before-request,reset",
        "num_retries": 3,
        # Limits how long a server may take to accept a WebSocket; a stalled one would keep the robot waiting.
        # It no longer applies once the WebSocket is open.
        "per_try_timeout": "0.5s",
        # A retry takes another server: a crashed one has the fewest requests, so the balancer would choose it
        # again until its health check fails.
        "retry_host_predicate": [
            {
                "name": "previous-hosts",
                "typed_config": {
                    "@type": f"{_TYPES}.extensions.retry.host.previous_hosts.v3.PreviousHostsPredicate"
                },
            }
        ],
        "host_selection_retry_max_attempts": "8",
    }
    route = {"cluster": CLUSTER, "timeout": "0s", "idle_timeout": "0s", "retry_policy": retry}
    rosbridge = [{"match": {"path": ROSBRIDGE_PATH}, "route": {**route, "cluster": ROSBRIDGE_CLUSTER}}]
    # A large upload has no total time limit; Envoy closes it after this time without a byte.  The data server
    # allows a third of that pause.  No retries: the robot itself resumes at the part that is missing.
    idle = _seconds(3 * BODY_TIMEOUT_S)
    data_route = {"cluster": DATA_CLUSTER, "timeout": "0s", "idle_timeout": idle}
    timeout = _seconds(settings.session.hello_timeout_s)
    return {
        "name": "platform",
        "domains": ["*"],
        "routes": [
            {"match": {"path": ROBOTS_PATH}, "route": route},
            *(rosbridge if settings.serving.rosbridge else ()),
            {"match": {"path": HEALTH_PATH}, "route": {**route, "timeout": timeout}},
            # Clients get 404, since each request would read the store.  Envoy's own health checks go to the
            # data server directly, and not through this listener.
            {"match": {"path": _DATA_READY}, "direct_response": {"status": 404}},
            *({"match": {"prefix": path}, "route": data_route} for path in (DATA_PATH, LOCALISE_PATH)),
        ],
    }


def _cluster(
    settings: PlatformSettings, name: str, endpoints_file: Path, ready: str, *, panic_percent: int
) -> dict[str, Any]:
    """Return the cluster *name* with the targets in *endpoints_file*; a healthy one answers *ready* with 200.

    While fewer than *panic_percent* of the targets are healthy, Envoy sends clients to all of them.
    """
    health = settings.health
    limits = ("max_connections", "max_requests", "max_pending_requests", "max_retries")
    return {
        "name": name,
        "type": "EDS",
        "eds_cluster_config": {
            "eds_config": {
                "path_config_source": {
                    "path": str(endpoints_file),
                    "watched_directory": {"path": str(endpoints_file.parent)},
                }
            }
        },
        "lb_policy": "LEAST_REQUEST",
        "common_lb_config": {
            # Changes of targets apply at once; the default delays a healthy new server by up to 1 s.
            "update_merge_window": "0s",
            # With 0 no robot is sent to a server that failed its checks, even if all of them did.
            "healthy_panic_threshold": {"value": panic_percent},
        },
        # A server that is removed from the endpoint file gets no new connections, also while it is healthy;
        # its open ones stay.
        "ignore_health_on_host_removal": True,
        "connect_timeout": "0.5s",
        "upstream_bind_config": {"socket_options": [_kernel_buffer(socket.SO_RCVBUF)]},
        "per_connection_buffer_limit_bytes": WRITE_BUFFER_BYTES,
        "circuit_breakers": {"thresholds": [dict.fromkeys(limits, _NO_LIMIT)]},
        "health_checks": [
            {
                "interval": _seconds(LOCAL_INTERVAL_S),
                # By default Envoy checks a server that has no traffic only once a minute.
                "no_traffic_interval": _seconds(LOCAL_INTERVAL_S),
                "timeout": _seconds(LOCAL_TIMEOUT_S),
                "unhealthy_threshold": health.unhealthy_checks,
                "healthy_threshold": HEALTHY_CHECKS,
                "http_health_check": {"path": ready},
            }
        ],
    }


def _address(host: str, port: int) -> dict[str, Any]:
    address = _LOOPBACK if host == "localhost" else host  # Envoy resolves no names here
    return {"socket_address": {"address": address, "port_value": port}}


def _seconds(value: float) -> str:
    return f"{value:.9f}".rstrip("0").rstrip(".") + "s"
