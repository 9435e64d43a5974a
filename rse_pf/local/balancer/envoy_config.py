"""The configuration of Envoy: one listener, two clusters, and endpoint files, the only part that changes.

Every value that differs from Envoy's default has its reason in a comment; most were found by measuring robots
while servers start, drain, stall and crash.
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

CLUSTER = "backend-servers"
ADMIN_SOCKET = "admin.sock"
"""In the balancer's folder.  The admin page can end the balancer, so it is not on a port."""
DATA_CLUSTER = "data-servers"
ROSBRIDGE_CLUSTER = "rosbridge-servers"
LISTENER = "front-door"
LOOPBACK_LISTENER = "loopback"
"""Where the rosbridge server connects the robots of its clients: without TLS, whatever the front door has."""
_DATA_READY = "/data/readyz"
_TYPES = "type.googleapis.com/envoy"
_LOOPBACK = "127.0.0.1"
# Limit of Envoy's circuit breakers, which must not act before a server's own limit ``serving.max_robots``.
_NO_LIMIT = 1_000_000
# Headers of one request: robots send about ten.
_MAX_HEADERS = 64
_CIPHERS = (
    "ECDHE-ECDSA-AES128-GCM-SHA256", "ECDHE-RSA-AES128-GCM-SHA256", "ECDHE-ECDSA-AES256-GCM-SHA384",
    "ECDHE-RSA-AES256-GCM-SHA384", "ECDHE-ECDSA-CHACHA20-POLY1305", "ECDHE-RSA-CHACHA20-POLY1305",
)  # fmt: skip
"""Of TLS 1.2: those that authenticate what they encrypt, with forward secrecy.  TLS 1.3 has no others."""
# Connections of robots and other clients; more are closed.  10,000 robots and their data requests fit.
_MAX_CONNECTIONS = 12_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """A backend server as the load balancer sees it."""

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
    """Return the static configuration.

    Args:
        settings: Address and path of the listener, health checks, handshake limit.
        port: Of the listener; 0 takes a free one.
        endpoints_file: What `endpoints` returned, as JSON; replaced by rename, never written in place.
        data_endpoints_file: The same for the data servers; without targets ``/data/`` is answered with 503.
        rosbridge_endpoints_file: The same for the rosbridge server, where ``serving.rosbridge`` is on.
        loopback_port: Of `LOOPBACK_LISTENER`; 0 takes a free one.
        lan: Listens on its address instead, with TLS and its certificate.
    """
    listeners = [_listener(settings, port, lan)]
    clusters = [
        _cluster(settings, CLUSTER, endpoints_file, READY_PATH, panic_percent=0),
        # One data server, and its successor on the same port: better asked in vain than not asked.
        _cluster(settings, DATA_CLUSTER, data_endpoints_file, _DATA_READY, panic_percent=100),
    ]
    if settings.serving.rosbridge:
        listeners.append(_loopback_listener(settings, loopback_port))
        clusters.append(
            _cluster(settings, ROSBRIDGE_CLUSTER, rosbridge_endpoints_file, HEALTH_PATH, panic_percent=100)
        )
    return {
        "node": {"id": "front-door", "cluster": "rse-pf"},  # endpoint files are refused without
        "admin": {"address": {"pipe": {"path": ADMIN_SOCKET, "mode": 0o600}}},
        "overload_manager": _max_connections(_MAX_CONNECTIONS),
        "static_resources": {"listeners": listeners, "clusters": clusters},
    }


def endpoints(targets: Sequence[Target], cluster: str = CLUSTER) -> dict[str, Any]:
    """Return the endpoint file of *cluster*: robots go to ``port``, health checks to ``control_port``."""
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
        # An open WebSocket is one endless request: only the robot and the server may end it.
        "stream_idle_timeout": "0s",
        "request_timeout": "0s",
        "common_http_protocol_options": {
            # For connections without a request; an open WebSocket is a request.
            "idle_timeout": _seconds(settings.session.hello_timeout_s),
            # Otherwise a client without a token keeps its connection by useless requests.  After this time a
            # connection closes with its next reply; what is open then, also a WebSocket, is not cut.
            "max_connection_duration": _seconds(settings.session.hello_timeout_s),
            "max_headers_count": _MAX_HEADERS,
            "headers_with_underscores_action": "REJECT_REQUEST",
        },
        # After max_connection_duration, for the next request.
        "drain_timeout": _seconds(settings.session.hello_timeout_s),
        # The default of 1 s makes every close take a second, and hides a dead server from its robots.
        "delayed_close_timeout": "0s",
        "request_headers_timeout": _seconds(settings.session.hello_timeout_s),
        "max_request_headers_kb": MAX_HANDSHAKE_BYTES // 1024,
        # Envoy replaces the address that a robot claims by the address of its connection.
        "use_remote_address": True,
        # Unauthenticated clients learn neither the software nor the time that a server took.
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
        # With the default a second Envoy would share a taken port in silence.
        "enable_reuse_port": False,
        # A burst of new connections does not delay connected robots.
        "max_connections_to_accept_per_socket_event": 1,
        # Behind a slow reader no more is kept, here and in the kernel, than a server would keep itself.
        "per_connection_buffer_limit_bytes": WRITE_BUFFER_BYTES,
        "socket_options": [_kernel_buffer(socket.SO_SNDBUF), _unread_timeout(settings)],
        "filter_chains": [{"filters": [{"name": "http", "typed_config": manager}], **_tls(settings, lan)}],
    }


def _loopback_listener(settings: PlatformSettings, port: int) -> dict[str, Any]:
    plain = settings.replace(local={"certificate": "", "private_key": ""}, serving={"host": _LOOPBACK})
    return {**_listener(plain, port, None), "name": LOOPBACK_LISTENER}


def _tls(settings: PlatformSettings, lan: LanListener | None) -> dict[str, Any]:
    """Return the transport of the listener: none, or TLS 1.2 and 1.3 with authenticated ciphers only."""
    if lan is None and not settings.local.certificate:
        return {}
    context = {
        "@type": f"{_TYPES}.extensions.transport_sockets.tls.v3.DownstreamTlsContext",
        # A stolen ticket would resume a session for hours, and a robot connects seldom.
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
    """Return where Envoy finds the certificate; a renewed one serves new connections at once."""
    file = secret_file(lan.folder)
    source = {"path": str(file), "watched_directory": {"path": str(file.parent)}}
    config = {"path_config_source": source, "resource_api_version": "V3"}
    return {"tls_certificate_sds_secret_configs": [{"name": CERTIFICATE_NAME, "sds_config": config}]}


def _kernel_buffer(name: int) -> dict[str, Any]:
    return {
        "level": socket.SOL_SOCKET, "name": name, "int_value": WRITE_BUFFER_BYTES, "state": "STATE_PREBIND",
    }  # fmt: skip


def _unread_timeout(settings: PlatformSettings) -> dict[str, Any]:
    """Close a connection whose robot reads nothing: Envoy would keep it and its unread bytes without end."""
    session = settings.session
    max_ms = int(2e3 * (session.ping_interval_s + session.ping_timeout_s))
    return {
        "level": socket.IPPROTO_TCP,
        "name": socket.TCP_USER_TIMEOUT,
        "int_value": max_ms,
        "state": "STATE_PREBIND",
    }


def _max_connections(most: int) -> dict[str, Any]:
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
        # A stalled server would keep a robot waiting for ever; ends with the upgrade, cuts no socket.
        "per_try_timeout": "0.5s",
        # A dead server has no requests and would look like the best choice until its check fails.
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
    # A large upload has no time limit while bytes flow; the data server is stricter.
    # No retries: the robot resumes at the part that is missing.
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
            # Each would ask the store; the balancer's own checks do not pass the listener.
            {"match": {"path": _DATA_READY}, "direct_response": {"status": 404}},
            *({"match": {"prefix": path}, "route": data_route} for path in (DATA_PATH, LOCALISE_PATH)),
        ],
    }


def _cluster(
    settings: PlatformSettings, name: str, endpoints_file: Path, ready: str, *, panic_percent: int
) -> dict[str, Any]:
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
            # The default of 1 s holds a new server back for a second although it is healthy.
            "update_merge_window": "0s",
            # 0: no traffic to servers that failed their checks, however many they are.
            "healthy_panic_threshold": {"value": panic_percent},
        },
        # A server that leaves the file gets nothing new, and keeps its open sockets.
        "ignore_health_on_host_removal": True,
        "connect_timeout": "0.5s",
        "upstream_bind_config": {"socket_options": [_kernel_buffer(socket.SO_RCVBUF)]},
        "per_connection_buffer_limit_bytes": WRITE_BUFFER_BYTES,
        "circuit_breakers": {"thresholds": [dict.fromkeys(limits, _NO_LIMIT)]},
        "health_checks": [
            {
                "interval": _seconds(LOCAL_INTERVAL_S),
                # By default a server without traffic is asked once a minute only.
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
