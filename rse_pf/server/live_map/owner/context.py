"""What surrounds the owner of a live map: the map's name, time, threads, registry and listeners."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rse_pf.accounts import TenantAccount
from rse_pf.config import LiveSettings
from rse_pf.maps.registry import MapRegistry
from rse_pf.server.live_map.owner.keyframe_objects import KeyframeObjects
from rse_pf.server.live_map.owner.state import MapKind
from rse_pf.server.live_map.owner.threads import OwnerThreads, Sleep
from rse_pf.server.live_map.owner.whole_fit import WholeFit, fit_here
from rse_pf.server.log import JsonLog

__all__ = ["OwnerContext"]


@dataclass(frozen=True, slots=True, kw_only=True)
class OwnerContext:
    """What surrounds an owner: the map's name, time, threads, registry and listeners.

    Attributes:
        clock: Seconds, monotonic.
        wall_clock: Unix seconds.
        sleep: Waits for seconds.
        account: Of the tenant, which is charged with what the map stores.
        objects: What robots store beside their keyframes.
        tell: Gets each new payload.
        on_beat: Gets the number of each renewal of the lease.
        on_use: Gets whether the map is used: commands came, or none for a while.
        fit: Fits a whole graph.
    """

    map_name: str
    settings: LiveSettings
    kind: MapKind
    threads: OwnerThreads
    maps: MapRegistry
    clock: Callable[[], float]
    wall_clock: Callable[[], float]
    sleep: Sleep
    account: TenantAccount
    objects: KeyframeObjects
    log: JsonLog
    tell: Callable[[dict[str, Any]], None]
    on_beat: Callable[[int], None]
    on_use: Callable[[bool], None] = lambda is_used: None
    fit: WholeFit = fit_here
