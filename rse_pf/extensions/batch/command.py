"""Merge maps that outgrow one process: in parts, by worker processes here or by those of a Dask scheduler.

Finished parts are kept in the store of the maps, so that the same command continues after an interruption: a
worker that exits is replaced, a scheduler that exits is started again, and Ctrl-C or a crash of this machine
lose at most the parts that were being computed.  The result is that of rse-pf map merge, plus edges from
aligned clouds (--no-icp leaves them out).  --scheduler uses the workers of a Dask scheduler that runs.

examples:
  rse-pf batch run merge robot-1 robot-2 robot-3 --out kitchen
  rse-pf batch run merge robot-1 robot-2 --out kitchen --store s3:maps --scheduler tcp://10.0.1.7:8786
  rse-pf batch clean
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass

from rse_pf.aws.storage import open_data_store
from rse_pf.command_line.extras import require
from rse_pf.command_line.map_store import head_id, open_maps, split_version, with_store
from rse_pf.command_line.merge_output import commit_merge, merge_progress
from rse_pf.command_line.options import Action, option
from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.maps.registry import MapOrigin
from rse_pf.terminal import counted, show

__all__ = ["ACTION"]

# Default of --workers: a number of worker processes with which a laptop can still be used.
_WORKERS = 2
# Largest --workers: a worker takes about 200 MB of memory, so that a larger number is a mistake.
_MAX_WORKERS = 64


@dataclass(frozen=True, kw_only=True)
class CleanRequest:
    """Options of ``rse-pf batch clean``: the store from which the parts of all merges are deleted."""

    store: str | None = option(
        "--store",
        help="store of the maps: dir:PATH or s3:BUCKET (default: data.store, or that of rse-pf local)",
    )

    def settings_with_store(self, settings: PlatformSettings) -> PlatformSettings:
        """Return *settings* with the store of the request; a folder as absolute path, since workers open it.

        Raises:
            UsageError: The store cannot be used.
        """
        chosen = with_store(self.store, settings)
        kind, _, path = chosen.data.store.partition(":")
        return chosen.replace(data={"store": f"dir:{os.path.abspath(path)}"}) if kind == "dir" else chosen


@dataclass(frozen=True, kw_only=True)
class MergeInPartsRequest(CleanRequest):
    """Options of ``rse-pf batch run merge``: the maps to merge, and the workers that compute the parts."""

    names: tuple[str, ...] = option(
        nargs="+",
        metavar="MAP",
        help="MAP or MAP@VERSION; the world frame of the first is kept; a single map gets its loops closed",
    )
    out: str = option("--out", required=True, metavar="MAP", help="the map that gets a new version")
    workers: int | None = option(
        "--workers",
        metavar="N",
        help=f"worker processes on this machine, 1 to {_MAX_WORKERS} (default: {_WORKERS})",
    )
    candidates: int = option(
        "--candidates",
        default=8,
        metavar="N",
        help="number of similar keyframes with which each keyframe is compared (default: 8)",
    )
    no_icp: bool = option("--no-icp", help="do not align clouds")
    scheduler: str | None = option(
        "--scheduler",
        metavar="ADDRESS",
        help="use the workers of the Dask scheduler at ADDRESS, not of this machine; they need the store",
    )
    tenant: str = option("--tenant", default="default", help="tenant of the maps (default: %(default)s)")
    note: str = option("--note", default="", help="note of the new version")
    json: bool = option("--json", help="print JSON")


def merge_in_parts(request: MergeInPartsRequest, settings: PlatformSettings) -> int:
    """Merge maps in parts and commit the merged map; return 1 if a map was not joined, else 0."""
    settings = request.settings_with_store(settings)
    require("batch run")
    from rse_pf.extensions.batch.dask_engine import Cluster, DaskEngine, LocalCluster, RemoteCluster
    from rse_pf.extensions.batch.merge import BatchMerge
    from rse_pf.services.mapping.merge import reply_of
    from rse_pf.slam.loop_closures import MergeOptions

    if request.scheduler is not None and request.workers is not None:
        raise UsageError(
            "--workers and --scheduler exclude each other", hint="the scheduler has workers of its own"
        )
    workers = _WORKERS if request.workers is None else request.workers
    if not 1 <= workers <= _MAX_WORKERS:
        raise UsageError(
            f"--workers {workers} is not within 1..{_MAX_WORKERS}", hint="choose one for each free core"
        )
    cluster: Cluster = (
        LocalCluster(workers) if request.scheduler is None else RemoteCluster(request.scheduler)
    )
    store = open_data_store(settings)
    maps = open_maps(settings, request.tenant)
    options = MergeOptions(candidates=request.candidates)
    versions = map(split_version, request.names)
    inputs = [maps.blob_name(name, maps.record(name, version)) for name, version in versions]
    parent = head_id(request.out, maps)
    engine = DaskEngine(store, settings, cluster, on_event=lambda text: show(text, error=True))
    merge = BatchMerge(store, engine, settings, options=options, align_clouds=not request.no_icp)
    began = time.perf_counter()
    try:
        engine.start()
        result = merge.run(inputs, merge_progress)
    finally:
        engine.close()
        cluster.stop()
    seconds = round(time.perf_counter() - began, 3)
    fields = {
        "seconds": seconds,
        "parts": {"computed": result.computed, "found": result.found},
        "clouds": len(result.tiles),
    }
    origin = MapOrigin(
        parent=parent, author="rse-pf batch run merge", created_s=time.time(), note=request.note
    )
    code = commit_merge(
        reply_of(result.merged), maps, request.names, into=request.out, origin=origin,
        json_fields=fields if request.json else None,
    )  # fmt: skip
    merge.forget()
    if not request.json:
        show(
            f"{'parts':<11} {result.computed} computed, {result.found} found; "
            f"{counted(len(result.tiles), 'edge')} from aligned clouds; {seconds:.1f} s"
        )
    return code


def delete_parts(request: CleanRequest, settings: PlatformSettings) -> None:
    """Delete the stored parts of all merges, also of running ones, and print the number of objects."""
    from rse_pf.extensions.batch.parts import PREFIX

    store = open_data_store(request.settings_with_store(settings))
    names = [info.name for info in store.list(f"{PREFIX}/")]
    for name in names:
        store.delete(name)
    show(f"{counted(len(names), 'object')} deleted")


# Example in the help and in errors.
_EXAMPLE = "rse-pf batch run merge robot-1 robot-2 --out kitchen"
ACTION = Action(
    actions={
        "run": Action(
            help="run one long computation in parts",
            example=_EXAMPLE,
            actions={
                "merge": Action(
                    help="merge several maps into one, or close the loops of one map",
                    example=_EXAMPLE,
                    request=MergeInPartsRequest,
                    run=merge_in_parts,
                )
            },
        ),
        "clean": Action(
            help="delete the parts of merges that were not finished",
            description="Delete the parts of merges that were not finished; a merge that still runs fails.",
            example="rse-pf batch clean",
            request=CleanRequest,
            run=delete_parts,
        ),
    }
)
