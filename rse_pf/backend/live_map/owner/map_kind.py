"""The map that owners serve; the process of an owner imports it before it claims a map."""

from __future__ import annotations

from rse_pf.backend.live_map.owner.state import MapKind
from rse_pf.live_map.live_map import LiveMap
from rse_pf.live_map.versions import started_from

__all__ = ["LIVE_MAP"]

LIVE_MAP = MapKind(empty=LiveMap, restore=LiveMap.restore_parts, started_from=started_from)
