"""Every port, path and threshold of the platform as one table: default, unit, range, source and help.

``context."rse-pf"`` of ``cdk.json`` holds overrides only.  Numbers that no operator changes are constants
where they are used.  Nothing here reads a file or the environment.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from rse_pf.config.elasticity import check_elasticity
from rse_pf.config.profiles import with_profile
from rse_pf.config.validation import (
    WHERE,
    SettingRow,
    check_buckets,
    check_burst_url,
    check_cidr,
    check_deployment,
    check_origin,
    check_range,
    did_you_mean,
    setting,
    typed,
)
from rse_pf.errors import SettingsError

__all__ = [
    "LIVE_PORTS",
    "AuthSettings",
    "BatchSettings",
    "BurstSettings",
    "CloudSettings",
    "DataSettings",
    "HealthSettings",
    "LiveSettings",
    "LocalSettings",
    "PlatformSettings",
    "PnpSettings",
    "RecordingSettings",
    "ScalingSettings",
    "ServiceSettings",
    "ServingSettings",
    "SessionSettings",
    "setting_rows",
]


LIVE_PORTS = 64
"""Number of ports for map servers from ``live.first_port`` on, one for each map server of a backend server;
the firewall opens them between servers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServingSettings:
    """One backend server: its sockets, workers and queue."""

    host: str = setting("127.0.0.1", doc="address the robots' socket listens on")
    port: int = setting(8765, doc="port of the robots' socket; 0 takes a free one", low=0, high=65535)
    control_host: str = setting("127.0.0.1", doc="address of the control port")
    control_port: int = setting(8766, doc="port of /healthz, /readyz, /metrics and drain; 0 takes a free one", low=0, high=65535)
    rosbridge: bool = setting(False, doc="also serve rosbridge v2 clients, on the path /rosbridge")
    workers: int = setting(0, doc="worker processes of a server; 0: one per core, or one if rse-pf local runs several servers on a machine", low=0, high=256)
    max_robots: int = setting(10000, unit="robots", doc="most robots that are connected to one server; more are refused with 503", low=1)
    max_unauthenticated: int = setting(200, unit="sockets", doc="most sockets without a verified token; the oldest one is closed when a new one exceeds the limit", low=1)
    max_unauthenticated_per_source: int = setting(50, unit="sockets", doc="most sockets without a verified token from one source address; not counted behind trusted proxies; 0 is off", low=0)
    max_accepts_per_s: float = setting(500.0, unit="sockets/s", doc="most new sockets that are passed to workers each second; more wait; 0 is off", low=0)
    max_handshakes_per_source_per_s: float = setting(200.0, unit="handshakes/s", doc="most handshakes of one source address in a second; more are refused with 429; 0 is off", low=0)
    trusted_proxies: int = setting(1, unit="proxies", doc="proxies between robots and servers that append to x-forwarded-for, the load balancer of the platform included: 1, or 2 behind a proxy of your own; 0: robots connect to the servers directly", low=0, high=8)
    allowed_origins: str = setting("", doc="origins of web pages that may connect, such as https://robots.example.org, with spaces between; pages of the platform itself always may")
    slow_reader_timeout_s: float = setting(1.0, unit="s", doc="a robot that does not read its answers for this long is disconnected", low=0.05)
    emulated_cores: float = setting(0.0, unit="cores", doc="CPU seconds per second that each worker may use, to emulate a smaller server; 0 is off", low=0, high=64)
    max_compute_memory_bytes: int = setting(1073741824, unit="bytes", doc="most memory that one command of a map service may use; its process is killed above this", low=67108864)
    max_compute_s: float = setting(20.0, unit="s", doc="most CPU time that one command of a map service may use; its process is killed above this", low=0.1)
    max_running_jobs: int = setting(1, doc="most long jobs that run at the same time on one server; 0 turns long services off", low=0, high=64)
    max_job_memory_bytes: int = setting(2147483648, unit="bytes", doc="most memory that one job may use; it is killed above this", low=134217728)
    job_lease_s: float = setting(5.0, unit="s", doc="a job whose lease was not renewed for this long is started again on another server when its robot asks", low=0.1)
    drain_wait_s: float = setting(1.0, unit="s", doc="a draining server reports not ready for this long before it moves its robots", low=0)
    log_level: str = setting("info", doc="least level of the lines that are logged", choices=("debug", "info", "warning", "error"))


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionSettings:
    """The protocol between a robot and a server: limits, pings, reconnects."""

    max_message_bytes: int = setting(262144, unit="bytes", doc="largest WebSocket message, as it is transmitted", low=1024)
    max_inflated_bytes: int = setting(1048576, unit="bytes", doc="largest message after decompression", low=1024)
    max_fragments: int = setting(64, doc="most WebSocket fragments of one message, empty fragments included", source="GHSA-96hv-2xvq-fx4p", low=1)
    max_in_flight: int = setting(8, unit="commands", doc="most unanswered commands of one robot; more are refused as busy", low=1)
    max_commands_per_s: float = setting(20.0, unit="commands/s", doc="most messages of one robot in a second; more are refused; 0 is off", source="AWS IoT and Discord limit so", low=0)
    ping_interval_s: float = setting(2.0, unit="s", doc="time between application pings", source="paper, Sect. 3.3 (delays); ours in value", low=0.05)
    ping_timeout_s: float = setting(3.0, unit="s", doc="a connection without an answer to a ping for this long counts as lost", low=0.1)
    hello_timeout_s: float = setting(5.0, unit="s", doc="a socket is closed when its handshake, or after it the Hello message, takes longer", source="slowloris, OWASP", low=0.1)
    answer_timeout_s: float = setting(5.0, unit="s", doc="deadline of a command that sets none", low=0.05)
    stall_timeout_s: float = setting(1.0, unit="s", doc="the client reconnects when a command is unanswered and nothing arrived for this long", low=0.05)


@dataclass(frozen=True, slots=True, kw_only=True)
class PnpSettings:
    """The perspective-n-point service ``pnp``."""

    engine: str = setting("native", doc="solver of a command that chooses none; opencv is the paper's, for comparisons", choices=("native", "opencv"))


@dataclass(frozen=True, slots=True, kw_only=True)
class HealthSettings:
    """When a server counts as unhealthy."""

    unhealthy_checks: int = setting(2, unit="checks", doc="failed checks in a row after which a server is unhealthy", low=2, high=10)


@dataclass(frozen=True, slots=True, kw_only=True)
class ScalingSettings:
    """When servers are added and removed, and how many there may be."""

    busy_cpu_percent: float = setting(70.0, unit="%", source="paper, Sect. 6.2", doc="add a server above this average CPU", low=20, high=100)
    idle_s: int = setting(300, unit="s", source="paper, Sect. 6.2", doc="remove a server after this long without a command of a robot, and with less than 20 % CPU; commands of synthetic robots, such as the canary, do not count", low=60)
    period_s: int = setting(60, unit="s", doc="length of one CPU sample of the monitor, in the profile paper", low=10)
    min_servers: int = setting(2, unit="servers", doc="fewest backend servers that scaling keeps", low=1)
    max_servers: int = setting(10, unit="servers", doc="most backend servers that scaling starts", low=1)
    warm_up_s: int = setting(60, unit="s", doc="time after its start for which the CPU of a new server does not count", low=0)
    max_robots_per_server: int = setting(0, unit="robots", source="paper, Sect. 3.1", doc="add a server when there are more robots per server than this; 0 is off", low=0)
    profile: str = setting("paper", doc="how fast load is noticed; paper: samples of scaling.period_s; fast: three samples of 10 s that the servers publish themselves", choices=("paper", "fast"))
    underused_s: int = setting(900, unit="s", doc="remove a server after CPU was below 15 % for this long, although robots send commands; 0 is off", low=0, high=86400)
    schedule: str = setting("", doc="min_servers by day and time, such as: weekdays 08:00 min 4; weekdays 18:00 min 1; sat,sun 10:00 min 2")
    time_zone: str = setting("UTC", doc="time zone of scaling.schedule, such as Asia/Seoul", source="IANA time zones")

    @property
    def very_busy_cpu_percent(self) -> float:
        """Return the average CPU (%) above which two servers are added: halfway from busy to 100 %."""
        return (self.busy_cpu_percent + 100.0) / 2


@dataclass(frozen=True, slots=True, kw_only=True)
class DataSettings:
    """Data servers: images, keyframes, clouds and maps."""

    enabled: bool = setting(True, doc="run the data service on each backend server on AWS, and keep objects and maps in the map bucket; without it servers there share no objects, maps or jobs, and have no live maps")
    store: str = setting("memory:", doc="object store: dir:PATH, s3:BUCKET or memory:")
    port: int = setting(8767, doc="port of the data service; 0 takes a free one", low=0, high=65535)
    host: str = setting("127.0.0.1", doc="address the data service listens on")
    max_object_bytes: int = setting(268435456, unit="bytes", doc="largest object", low=1024)
    quota_bytes: int = setting(10737418240, unit="bytes", doc="most bytes that the objects, uploads and committed map versions of one robot may use together", low=1024)
    tenant_quota_bytes: int = setting(107374182400, unit="bytes", doc="most bytes that one tenant may store: objects, maps with all their versions, live maps, states of services and waiting jobs", low=1024)
    max_objects: int = setting(100000, unit="objects", doc="most objects, unfinished uploads and map versions of one robot together", source="file systems run out of inodes", low=1)
    max_requests_per_s: float = setting(50.0, unit="requests/s", doc="most requests of one robot in a second; a list counts as 5, a photo to localise as 10 or one for each 5 ms of its CPU time, a commit of a map as 20; more are refused with 429", low=0.1)
    part_bytes: int = setting(4194304, unit="bytes", doc="largest body of one request; larger objects are sent in parts", low=1024)
    max_uploads: int = setting(32, doc="most request bodies that are received at the same time; more are refused with 503 and Retry-After", low=1)


@dataclass(frozen=True, slots=True, kw_only=True)
class AuthSettings:
    """Tokens of robots: their audience, validity and use."""

    audience: str = setting("rse-pf", doc="audience (aud) of the tokens")
    token_ttl_s: int = setting(900, unit="s", doc="longest validity of a robot token", source="RFC 8725; short-lived", low=10, high=900)
    leeway_s: int = setting(30, unit="s", doc="difference between the clocks of robot and server that is tolerated", low=0, high=300)
    required: bool = setting(True, doc="whether robots without a token are refused")


@dataclass(frozen=True, slots=True, kw_only=True)
class ServiceSettings:
    """Services that the operator installs; each robot has a sandbox of its own."""

    folder: str = setting("", doc="folder of installed services; empty means none")
    follow: bool = setting(False, doc="the services folder is a symbolic link that may change while the server runs: load it again at POST /services of the control port, and leave out services that cannot be loaded")
    published: bool = setting(False, doc="also run the services that installed Python packages publish (entry points rse_pf.services)")
    max_sandboxes: int = setting(64, doc="most sandboxes of one server", low=1)
    memory_bytes: int = setting(536870912, unit="bytes", doc="most memory of one sandbox: its address space and its scratch folder of 16 MiB together", low=16777216)
    grace_s: float = setting(5.0, unit="s", doc="a sandbox is kept for this long after the connection of its robot ended", low=0)
    breaker_crashes: int = setting(5, unit="crashes", doc="crashes of a service within 30 s that open its circuit breaker", low=2)
    accept_weak_isolation: bool = setting(False, doc="run installed services even if the kernel lacks a means of isolation")


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveSettings:
    """Maps that robots build together while they drive; each has a map server, a process of one backend server."""

    host: str = setting("127.0.0.1", doc="address on which map servers listen for other backend servers; 0.0.0.0 listens on all addresses and announces the main one")
    first_port: int = setting(8800, doc="first of the 64 ports of map servers; on loopback, and with 0, any free port is taken", low=0, high=65535 - 63)
    max_owners: int = setting(4, doc="most map servers of one worker; more maps are refused until another backend server takes them; 0 switches live maps off", low=0, high=64)
    warm_standby: bool = setting(True, doc="keep one started process, about 70 MB, in each worker whose robots use live maps; a takeover is then a second shorter")
    lease_s: float = setting(1.5, unit="s", doc="another server takes a live map over when its lease was not renewed for this long", low=0.1)
    publish_pause_s: float = setting(10.0, unit="s", doc="shortest time between two published versions of a live map; an earlier request waits", source="a robot that left again and again wrote 959 MB in 45 s", low=0)
    keep_versions: int = setting(20, unit="versions", doc="automatic versions of a live map that are kept, at most a quarter of the tenant's quota; older ones are removed; 0 keeps all", low=0)
    idle_s: float = setting(60.0, unit="s", doc="a map server publishes its map and exits when no robot used the map for this long", low=1)
    images: bool = setting(False, doc="robots store the image of each keyframe of a live map, about 60 kB each, for exports of its versions")
    keep_log: bool = setting(False, doc="keep the whole log of a live map, for replays in experiments; otherwise entries before the older snapshot are deleted")


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingSettings:
    """Recordings of the messages of robots and servers, which rse-pf replay reads."""

    folder: str = setting("", doc="folder of recordings; empty: nothing is recorded")
    max_bytes: int = setting(4294967296, unit="bytes", doc="size of all recordings of the folder above which the oldest files are deleted", low=1048576)


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchSettings:
    """Merges that are computed in parts: rse-pf batch."""

    pairs_per_part: int = setting(500, unit="pairs", doc="keyframe pairs of one part of a merge; a part is computed again if its worker is killed", source="5.3 ms for a pair of 1,000 features each: 2.7 s", low=10, high=100000)


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalSettings:
    """The platform on one machine: rse-pf local."""

    port: int = setting(8700, doc="port of the local load balancer; 0 takes a free one", low=0, high=65535)
    servers: int = setting(2, unit="servers", doc="backend servers at the start", low=1, high=64)
    start_timeout_s: float = setting(20.0, unit="s", doc="a server that is not ready within this time after its start has failed", low=1)
    warm_standby: bool = setting(True, doc="keep one started process, about 60 MB, that becomes the next server at once", source="warm pools of AWS Auto Scaling")
    metrics_port: int = setting(9464, doc="port of the control plane on loopback: /metrics of all servers, for Prometheus; 0 takes a free one", source="OpenTelemetry's Prometheus exporter", low=0, high=65535)
    page_port: int = setting(8701, doc="port of the fleet page on loopback; 0 takes a free one, and so does a port that is taken", low=0, high=65535)
    certificate: str = setting("", doc="file of the load balancer's certificate chain (PEM); robots then connect by wss://")
    private_key: str = setting("", doc="file of the private key of local.certificate (PEM)")


@dataclass(frozen=True, slots=True, kw_only=True)
class BurstSettings:
    """Poses from a serverless function while no server answers in time."""

    url: str = setting("", doc="where robots send commands by HTTP when no server answers in time: an address, or a path at the address of the platform; empty: /burst on AWS, and elsewhere nowhere")
    robot_commands_per_day: int = setting(10000, unit="commands", doc="most commands that a robot sends to burst.url in a day; it computes further ones by itself; 0: it sends none", low=0)
    commands_per_5_minutes: int = setting(50000, unit="commands", doc="most commands of all robots to the serverless PnP in five minutes, a rule of AWS WAF; more are refused with 429", low=100)


@dataclass(frozen=True, slots=True, kw_only=True)
class CloudSettings:
    """The platform on AWS."""

    name: str = setting("", doc="name of the deployment, for several in one account: up to 16 small letters, digits and hyphens; empty for the only one")
    bootstrap_qualifier: str = setting("hnb659fds", doc="qualifier with which the account was bootstrapped for the CDK", source="the CDK's default")
    region: str = setting("ap-northeast-2", doc="AWS region", source="paper, Sect. 6.1 (Seoul)")
    allow_insecure: bool = setting(True, doc="true: ws:// without a certificate, for trials only; false: wss://")
    certificate_arn: str = setting("", doc="ACM certificate of the load balancer; required if allow_insecure is false")
    domain_name: str = setting("", doc="DNS name of the load balancer; required if allow_insecure is false")
    instance_type: str = setting("c7i.large", doc="EC2 type of a backend server (x86-64)")
    other_instance_types: str = setting("", doc="further EC2 types that serve where instance_type is not to be had, with spaces between; of the same size")
    warm_servers: int = setting(0, unit="servers", doc="stopped servers that are ready to start; not together with spot or other_instance_types", source="warm pools of AWS Auto Scaling", low=0, high=50)
    spot: bool = setting(False, doc="all servers but one are Spot instances, which AWS may reclaim within two minutes")
    image_parameter: str = setting("/aws/service/debian/release/12/latest/amd64", doc="SSM parameter that names the machine image", source="Debian's public parameter")
    profile: str = setting("standard", doc="small: one zone for servers and endpoints, and one server of a small type unless you set these; see docs/operations.md", choices=("standard", "small"))
    canary: bool = setting(True, doc="a function that asks for one known pose through the load balancer every minute, and an alarm")
    budget_per_month: float = setting(0.0, unit="USD", doc="cost of the AWS account in a month: the topic of alarms is notified at 80 % of it, and when 100 % of it are forecast; 0 is off", low=0)
    s3_prefix_list: str = setting("", doc="prefix list of S3 in the region; empty: from the table in stacks/firewall.py")
    robot_cidr: str = setting("0.0.0.0/0", doc="range of IPv4 addresses from which robots may connect")
    robots_per_site: int = setting(100, unit="robots", doc="robots behind one source address that may all connect, and send data, in the same minute: the rules of AWS WAF allow so many", low=1, high=100000)
    lambda_concurrency: int = setting(20, doc="most concurrent executions of the Lambda function of the serverless PnP", low=1)
    idle_action: str = setting("auto", doc="what a deployment does that had no robots for 24 hours: park ends its servers until rse-pf cloud resume or scaling.schedule; none; auto: park a trial, and none with TLS (allow_insecure is false) or scaling.schedule", choices=("auto", "park", "none"))
    replica_maps: str = setting("", doc="map buckets of deployments in other regions, with spaces between; new versions of maps are copied there")
    replica_artifacts: str = setting("", doc="artifact buckets of deployments in other regions, with spaces between; public keys, roster, deny list and published services are copied there")
    audit_days: int = setting(365, unit="days", doc="an audit log in the bucket is locked for this long, and deleted a day later", low=1)


@dataclass(frozen=True, slots=True, kw_only=True)
class PlatformSettings:
    """All settings by group; creating an object with invalid or contradictory values raises SettingsError."""

    serving: ServingSettings = field(default_factory=ServingSettings)
    session: SessionSettings = field(default_factory=SessionSettings)
    pnp: PnpSettings = field(default_factory=PnpSettings)
    health: HealthSettings = field(default_factory=HealthSettings)
    scaling: ScalingSettings = field(default_factory=ScalingSettings)
    data: DataSettings = field(default_factory=DataSettings)
    auth: AuthSettings = field(default_factory=AuthSettings)
    services: ServiceSettings = field(default_factory=ServiceSettings)
    live: LiveSettings = field(default_factory=LiveSettings)
    recording: RecordingSettings = field(default_factory=RecordingSettings)
    batch: BatchSettings = field(default_factory=BatchSettings)
    local: LocalSettings = field(default_factory=LocalSettings)
    burst: BurstSettings = field(default_factory=BurstSettings)
    cloud: CloudSettings = field(default_factory=CloudSettings)

    def __post_init__(self) -> None:
        for row in setting_rows(self):
            check_range(row)
        _check_contradictions(self)

    @classmethod
    def from_dict(cls, overrides: Mapping[str, Any]) -> PlatformSettings:
        """Return the defaults of ``cloud.profile`` with *overrides*: ``{group: {name: value}}``.

        Raises:
            SettingsError: A group or setting is unknown, or a value is invalid or contradicts another one.
        """
        groups = typing.get_type_hints(cls)
        made: dict[str, Any] = {}
        for name, values in with_profile(overrides).items():
            if name not in groups:
                raise SettingsError(f"unknown group {name!r}", hint=did_you_mean(name, groups))
            if not isinstance(values, Mapping):
                raise SettingsError(
                    f"{name} must be an object of settings, got {type(values).__name__}",
                    hint=f'write "{name}": {{"setting": value}}',
                )
            made[name] = _make_group(name, groups[name], values)
        return cls(**made)

    def replace(self, **groups: Mapping[str, Any]) -> PlatformSettings:
        """Return a copy with the settings in *groups* replaced: ``group={name: value}``.

        Raises:
            SettingsError: A group or setting is unknown, or a value is invalid or contradicts another one.
        """
        merged: dict[str, Any] = self.to_dict()
        for name, values in groups.items():
            known = isinstance(values, Mapping) and name in merged
            merged[name] = {**merged[name], **values} if known else values
        return PlatformSettings.from_dict(merged)

    def to_dict(self) -> dict[str, dict[str, Any]]:
        """Return all settings as plain JSON values, defaults included."""
        return dataclasses.asdict(self)

    def digest(self) -> str:
        """Return the first 16 hex digits of the sha256 of all settings, which equal settings share."""
        canonical = json.dumps(self.to_dict(), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(canonical.encode()).hexdigest()[:16]


def _check_contradictions(s: PlatformSettings) -> None:
    """Raise SettingsError if settings contradict each other, or a text such as an origin is malformed."""
    pairs = [
        ("scaling", "min_servers", "max_servers"),
        ("session", "max_message_bytes", "max_inflated_bytes"),
    ]
    for group, small, large in pairs:
        low, high = (getattr(getattr(s, group), name) for name in (small, large))
        if low > high:
            raise SettingsError(
                f"{group}.{large} = {high:g} is less than {group}.{small} = {low:g}",
                hint=f"raise {group}.{large} or lower {group}.{small} {WHERE}",
            )
    if bool(s.local.certificate) != bool(s.local.private_key):
        raise SettingsError(
            f"local.certificate = {s.local.certificate!r} without local.private_key = "
            f"{s.local.private_key!r}",
            hint=f"set both files or neither {WHERE}",
        )
    check_burst_url("burst.url", s.burst.url)
    for origin in s.serving.allowed_origins.split():
        check_origin("serving.allowed_origins", origin)
    check_elasticity(dataclasses.asdict(s.scaling), dataclasses.asdict(s.cloud))
    check_deployment(s.cloud.name, s.cloud.bootstrap_qualifier)
    check_cidr("cloud.robot_cidr", s.cloud.robot_cidr)
    for name in ("replica_maps", "replica_artifacts"):
        check_buckets(f"cloud.{name}", getattr(s.cloud, name))
    _check_live_ports(s)
    if not s.cloud.allow_insecure and not (s.cloud.certificate_arn and s.cloud.domain_name):
        raise SettingsError(
            "cloud.allow_insecure = false needs cloud.certificate_arn and cloud.domain_name",
            hint=f"set both {WHERE}, or set cloud.allow_insecure to true",
        )


def _check_live_ports(s: PlatformSettings) -> None:
    """Raise SettingsError if a port of the map servers is also another port of the same backend server."""
    first, last = s.live.first_port, s.live.first_port + LIVE_PORTS - 1
    for name, port in (
        ("serving.port", s.serving.port), ("serving.control_port", s.serving.control_port),
        ("data.port", s.data.port),
    ):  # fmt: skip
        if first and first <= port <= last:
            raise SettingsError(
                f"{name} = {port} is one of the ports of live maps, {first} to {last}",
                hint=f"change {name} or live.first_port {WHERE}",
            )


def setting_rows(settings: PlatformSettings | None = None) -> Iterator[SettingRow]:
    """Yield every setting with its value in *settings* (None: the defaults), in the order of this file."""
    for group in dataclasses.fields(PlatformSettings):
        made: Any = getattr(settings or PlatformSettings(), group.name)
        for each in dataclasses.fields(made):
            yield SettingRow(
                group=group.name,
                name=each.name,
                value=getattr(made, each.name),
                default=each.default,
                **each.metadata,
            )


def _make_group(group: str, kind: type[Any], values: Mapping[str, Any]) -> Any:
    """Return the *group* of settings of the class *kind* with *values* by name; raises SettingsError."""
    hints = typing.get_type_hints(kind)
    checked = {}
    for name, value in values.items():
        if name not in hints:
            raise SettingsError(f"unknown setting {group}.{name}", hint=did_you_mean(name, hints))
        checked[name] = typed(f"{group}.{name}", value, hints[name])
    return kind(**checked)
