"""Publish a service to all servers on AWS, list the published services, or remove one: service publish.

Servers read the list of published services every 15 seconds, and load changed ones while robots are
connected; no server is restarted.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from rse_pf.cli.services.building import built_service
from rse_pf.command_line.extras import require
from rse_pf.command_line.options import option
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ResourceNames
from rse_pf.errors import UsageError
from rse_pf.services.custom.installed import install
from rse_pf.services.custom.publishing import (
    LIST_POLL_PERIOD_S,
    PublishedService,
    publish,
    read_list,
    unpublish,
)
from rse_pf.storage.object_store import ObjectStore
from rse_pf.terminal import show, show_json

__all__ = ["PublishRequest", "publish_service"]


@dataclass(frozen=True, kw_only=True)
class PublishRequest:
    """The options of rse-pf service publish: the service that is published or removed, or the list."""

    service: str | None = option(
        nargs="?", metavar="FOLDER", help="folder of the service; with --remove its name"
    )
    list: bool = option("--list", help="show the services that all servers run")
    remove: bool = option("--remove", help="remove the service with this name from the list")
    json: bool = option("--json", help="with --list: print JSON")


def publish_service(request: PublishRequest, settings: PlatformSettings) -> int:
    """Publish the service in a folder, remove a published one, or list all; return 0."""
    if request.list and (request.remove or request.service is not None):
        raise UsageError("--list takes no service and no --remove", hint="rse-pf service publish --list")
    if request.json and not request.list:
        raise UsageError("--json is for --list", hint="leave it out")
    require("service publish")
    if request.list:
        return _list(_store(settings), as_json=request.json)
    if request.service is None:
        raise UsageError(
            "rse-pf service publish needs the folder of a service",
            hint="write rse-pf service publish FOLDER, or --list",
        )
    if request.remove:
        unpublish(request.service, _store(settings))
        show(f"{request.service} is removed: servers stop offering it within {LIST_POLL_PERIOD_S} s")
        return 0
    built, dependencies = built_service(Path(request.service))
    with tempfile.TemporaryDirectory(prefix="rse-pf-publish-") as folder:
        service = install(built.folder, Path(folder), dependencies)
        entry = publish(service, Path(folder), _store(settings), now_s=time.time())
    show(
        f"{entry.name} ({entry.language}) is published: {entry.size} bytes, sha256 {entry.archive[:16]}",
        f"servers load it within {LIST_POLL_PERIOD_S} s; "
        f"rse-pf service publish {entry.name} --remove takes it out",
    )
    return 0


def _list(store: ObjectStore, *, as_json: bool) -> int:
    """Print the published services as lines or as JSON, and return 0."""
    services = read_list(store).services
    if as_json:
        show_json([_row(service) for service in services])
        return 0
    for service in services:
        at = time.strftime("%Y-%m-%d %H:%M", time.gmtime(service.published_s))
        show(
            f"{service.name:<24} {service.language:<8} {service.size:>10} bytes  "
            f"{service.identity[:12]}  {at} UTC"
        )
    if not services:
        show("no service is published")
    return 0


def _row(service: PublishedService) -> dict[str, object]:
    return {
        "name": service.name, "language": service.language, "bytes": service.size,
        "identity": service.identity,
        "archive": service.archive, "published_s": service.published_s, "packages": service.packages,
    }  # fmt: skip


def _store(settings: PlatformSettings) -> ObjectStore:
    """Return the artifact bucket of the deployment; raises ConfigurationError if there is none."""
    from rse_pf.aws.account import open_account
    from rse_pf.aws.storage.s3_store import S3Store

    account = open_account(settings.cloud.region)
    stack = ResourceNames(settings.cloud.name).stack("Data")
    return S3Store(account.client("s3"), account.resource(stack, "AWS::S3::Bucket", "Artifacts"))
