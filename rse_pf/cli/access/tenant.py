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

import argparse
from collections import Counter
from typing import Any

from rse_pf.auth.roster import check_tenant
from rse_pf.auth.trust_store import AccessControlStore
from rse_pf.aws.storage import S3Store, open_data_store
from rse_pf.cli.access.access_control import (
    add_platform,
    open_access_control,
    read_quotas,
    record_action,
)
from rse_pf.command_line.map_store import with_store
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

__all__ = ["add_arguments", "run"]

_COLUMNS = ("tenant", "robots", "stored_bytes", "quota_bytes", "quota_from")
_SETTING = "data.tenant_quota_bytes"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("action", choices=("list", "quota"), help="what to do")
    parser.add_argument("tenant", nargs="?", metavar="TENANT", help="quota: name of the tenant")
    parser.add_argument(
        "--quota", action="append", default=[], metavar="NAME=N",
        help="quota: data_bytes, how much the tenant may store, or default (data.tenant_quota_bytes)",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="list: as JSON")
    add_platform(parser)


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Do one action."""
    is_list = args.action == "list"
    if is_list != (args.tenant is None) or is_list == bool(args.quota):
        raise UsageError(
            "list takes no tenant, and quota needs one with its quota",
            hint="write rse-pf tenant quota TENANT --quota data_bytes=N",
        )
    access = open_access_control(args, settings)
    store, settings = _open_store(args, settings)
    return _list(args, access, store, settings) if is_list else _set_quota(args, access, store, settings)


def _open_store(args: argparse.Namespace, settings: PlatformSettings) -> tuple[ObjectStore, PlatformSettings]:
    """Return the store of the platform in *args*, and the settings that hold for it."""
    if args.cloud:
        from rse_pf.aws.account import open_account

        account, names = open_account(settings.cloud.region), ResourceNames(settings.cloud.name)
        bucket = account.resource(names.stack("Data"), "AWS::S3::Bucket", "Maps")
        return S3Store(account.client("s3"), bucket), settings
    settings = with_store(None, settings, args.name)
    return open_data_store(settings), settings


def _list(
    args: argparse.Namespace, access: AccessControlStore, store: ObjectStore, settings: PlatformSettings
) -> int:
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
    if args.json:
        show_json(rows, indent=2)
        return 0
    table = [_COLUMNS, *(tuple(str(row[name]) for name in _COLUMNS) for row in rows)]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    for cells in table:
        show("  ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)).rstrip())
    return 0


def _tenants(access: AccessControlStore, store: ObjectStore) -> list[str]:
    """Return the names of all tenants, sorted; the folder of one that has no robot and no plain name."""
    named = {robot.tenant for robot in access.roster().robots}
    named |= {robot.tenant for robot in access.deny_list().disabled}
    return sorted(named | (tenant_folders(store) - set(map(name_segment, named))))


def _set_quota(
    args: argparse.Namespace, access: AccessControlStore, store: ObjectStore, settings: PlatformSettings
) -> int:
    tenant, quota = check_tenant(args.tenant), read_quotas(args.quota).get("data_bytes")
    if tenant not in _tenants(access, store):
        raise UsageError(
            f"there is no tenant {tenant!r}: it has no robots, and stores nothing",
            hint="rse-pf tenant list shows all; enrol a robot of a new tenant first",
        )
    set_own_quota(store, name_segment(tenant), None if quota is None else int(quota))
    now_bytes = TenantAccount(store, tenant, settings.data).quota_bytes()
    record_action(args, settings, "tenant.quota", tenant, data_bytes=now_bytes)
    stored_bytes = stored_by_tenant(store, name_segment(tenant)).charged_bytes
    source = _SETTING if quota is None else "its own quota"
    show(f"tenant {tenant!r} may store {now_bytes} bytes ({source}), and stores {stored_bytes}")
    return 0
