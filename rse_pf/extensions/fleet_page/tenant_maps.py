"""The maps of all tenants of one local platform, each with a label: NAME, or TENANT/NAME.

The label of a map of the default tenant is its name.  Tenants whose names cannot be names of folders are left
out.
"""

from __future__ import annotations

from pathlib import Path

from rse_pf.aws.storage import open_data_store
from rse_pf.config import PlatformSettings
from rse_pf.identity import DEFAULT_TENANT, name_segment
from rse_pf.local.servers.backend_servers import local_placement
from rse_pf.local.state import platform_settings
from rse_pf.storage.object_store import ObjectStore

__all__ = ["map_label", "platform_store", "split_label", "tenants_with"]

# Largest number of tenants whose maps are shown besides the default one, the first by name: the page's
# server opens a connection to the platform for each.
_MAX_TENANTS = 32


def platform_store(folder: Path) -> ObjectStore:
    """Return the object store of the platform whose state is in *folder*."""
    settings = platform_settings(folder) or PlatformSettings()
    store = local_placement(settings, folder).store
    return open_data_store(settings.replace(data={"store": store}))


def tenants_with(store: ObjectStore, kind: str) -> list[str]:
    """Return the default tenant, and at most 32 others that have objects in the folder *kind*; blocking."""
    others = sorted(set(store.folders(f"{kind}/")) - {DEFAULT_TENANT})
    return [DEFAULT_TENANT, *[each for each in others if name_segment(each) == each][:_MAX_TENANTS]]


def map_label(tenant: str, name: str) -> str:
    """Return the label of the map *name* of *tenant*."""
    return name if tenant == DEFAULT_TENANT else f"{tenant}/{name}"


def split_label(label: str) -> tuple[str, str]:
    """Return tenant and name of the map with *label*; names of maps contain no slash."""
    tenant, _, name = label.rpartition("/")
    return tenant or DEFAULT_TENANT, name
