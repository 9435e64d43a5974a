"""List the tenants of a platform, and limit what one of them may store.

list shows each tenant with its enrolled robots, the bytes that it stores, and its quota.  A tenant is there
as soon as a robot of it is enrolled or something of it is stored.  quota gives one tenant a quota of its own;
data_bytes=default returns it to data.tenant_quota_bytes, which holds for all others.  What is stored already
stays, also above the quota.  A quota takes effect within 5 s, without a restart.

examples:
  rse-pf tenant list
  rse-pf tenant list --json
  rse-pf tenant quota acme --quota data_bytes=5e9
  rse-pf tenant quota acme --quota data_bytes=default
  rse-pf tenant list --cloud
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

from rse_pf.auth.roster import check_tenant
from rse_pf.auth.trust_store import AccessControlStore
from rse_pf.aws.storage import S3Store, open_data_store
from rse_pf.cli.access.access_control import PlatformRequest, read_quotas
from rse_pf.command_line.map_store import with_store
from rse_pf.command_line.options import Action, option
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ResourceNames
from rse_pf.errors import UsageError
from rse_pf.identity import name_segment
from rse_pf.storage.object_store import ObjectStore
from rse_pf.storage.quotas import (
    TenantAccount,
    own_quota_bytes,
    set_own_quota,
    stored_by_tenant,
    tenant_folders,
)
from rse_pf.terminal import show, show_json

__all__ = ["ACTION"]

_COLUMNS = ("tenant", "robots", "stored_bytes", "quota_bytes", "quota_from")
_SETTING = "data.tenant_quota_bytes"


@dataclass(frozen=True, kw_only=True)
class _ListRequest(PlatformRequest):
    json: bool = option("--json", help="print JSON")


@dataclass(frozen=True, kw_only=True)
class _QuotaRequest(PlatformRequest):
    tenant: str = option(metavar="TENANT", help="name of the tenant")
    quota: tuple[str, ...] = option(
        "--quota",
        action="append",
        required=True,
        default=(),
        metavar="NAME=N",
        help="data_bytes=N, the bytes that the tenant may store, or data_bytes=default "
        "(data.tenant_quota_bytes)",
    )


def _open_store(request: PlatformRequest, settings: PlatformSettings) -> tuple[ObjectStore, PlatformSettings]:
    """Return the object store of the platform of *request*, and the settings with its store and quotas."""
    if request.cloud:
        from rse_pf.aws.account import open_account

        account, names = open_account(settings.cloud.region), ResourceNames(settings.cloud.name)
        bucket = account.resource(names.stack("Data"), "AWS::S3::Bucket", "Maps")
        return S3Store(account.client("s3"), bucket), settings
    settings = with_store(None, settings, request.name)
    return open_data_store(settings), settings


def list_tenants(request: _ListRequest, settings: PlatformSettings) -> None:
    """Print a row for each tenant: its enrolled robots, the bytes that it stores, and its quota."""
    access = request.open_access_control(settings)
    store, settings = _open_store(request, settings)
    robots = Counter(robot.tenant for robot in access.roster().robots)
    rows: list[dict[str, Any]] = [
        {
            "tenant": tenant,
            "robots": robots[tenant],
            "stored_bytes": stored_by_tenant(store, name_segment(tenant)).charged_bytes,
            "quota_bytes": TenantAccount(store, tenant, settings.data).quota_bytes(),
            "quota_from": _SETTING if own_quota_bytes(store, name_segment(tenant)) is None else "own",
        }
        for tenant in _tenants(access, store)
    ]
    if request.json:
        show_json(rows, indent=2)
        return
    table = [_COLUMNS, *(tuple(str(row[name]) for name in _COLUMNS) for row in rows)]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    for cells in table:
        show("  ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)).rstrip())


def _tenants(access: AccessControlStore, store: ObjectStore) -> list[str]:
    """Return the names of all tenants, sorted: those of robots, and those that have stored something.

    A tenant of which only stored objects are left is named by its folder, which may be an encoded name.
    """
    named = {robot.tenant for robot in access.roster().robots}
    named |= {robot.tenant for robot in access.deny_list().disabled}
    return sorted(named | (tenant_folders(store) - set(map(name_segment, named))))


def set_quota(request: _QuotaRequest, settings: PlatformSettings) -> None:
    """Set the bytes that a tenant may store, or return it to the quota of the settings."""
    access = request.open_access_control(settings)
    store, settings = _open_store(request, settings)
    tenant, quota = check_tenant(request.tenant), read_quotas(request.quota).get("data_bytes")
    if tenant not in _tenants(access, store):
        raise UsageError(
            f"there is no tenant {tenant!r}: it has no robots, and stores nothing",
            hint="rse-pf tenant list shows all; enrol a robot of a new tenant first",
        )
    set_own_quota(store, name_segment(tenant), None if quota is None else int(quota))
    now_bytes = TenantAccount(store, tenant, settings.data).quota_bytes()
    request.record("tenant.quota", tenant, data_bytes=now_bytes)
    stored_bytes = stored_by_tenant(store, name_segment(tenant)).charged_bytes
    source = _SETTING if quota is None else "its own quota"
    show(f"tenant {tenant!r} may store {now_bytes} bytes ({source}), and stores {stored_bytes}")


ACTION = Action(
    actions={
        "list": Action(
            help="show all tenants, with the bytes that they store and their quotas",
            example="rse-pf tenant list",
            request=_ListRequest,
            run=list_tenants,
        ),
        "quota": Action(
            help="set the bytes that a tenant may store",
            example="rse-pf tenant quota acme --quota data_bytes=5e9",
            request=_QuotaRequest,
            run=set_quota,
        ),
    }
)
