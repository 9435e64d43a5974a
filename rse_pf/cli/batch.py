"""Merge maps that outgrow one process: in parts, by worker processes here or by those of a Dask scheduler.

Finished parts are kept in the store of the maps, so that the same command continues after an interruption: a
worker that ends is replaced, a scheduler that ends is started again, and Ctrl-C or a crash of this machine
lose at most the parts that were being computed.  The result is that of rse-pf map merge, plus links from
aligned clouds (--no-icp leaves them out).  --scheduler uses the workers of a Dask scheduler that runs.

examples:
  rse-pf batch run merge robot-1 robot-2 robot-3 --out kitchen --store dir:objects
  rse-pf batch run merge robot-1 robot-2 --out kitchen --store s3:maps --scheduler tcp://10.0.1.7:8786
  rse-pf batch clean --store dir:objects
"""

from __future__ import annotations

import argparse
import os
import time

from rse_pf.audit.operator import record_map_change
from rse_pf.aws.storage import open_data_store
from rse_pf.cli.maps.merge_output import commit_merge, merge_progress
from rse_pf.command_line.extras import require
from rse_pf.config import PlatformSettings
from rse_pf.errors import NotFound, UsageError
from rse_pf.identity import RobotId
from rse_pf.local.state import state_folder
from rse_pf.maps.registry import MapOrigin, MapRecord, MapRegistry
from rse_pf.storage.object_store import ObjectStore
from rse_pf.terminal import counted, show

__all__ = ["add_arguments", "run"]

_WORKERS = 2  # worker processes without --workers: a laptop stays usable
_MAX_WORKERS = 64  # each takes some 200 MB, so that more are a mistake


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the actions and their options."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--store", help="store of the maps: dir:PATH or s3:BUCKET (default: data.store)")
    run_ = actions.add_parser(
        "run", help="run one long computation in parts", description="Run one long computation in parts.",
        epilog="example:\n  rse-pf batch run merge robot-1 robot-2 --out kitchen --store dir:objects",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    jobs = run_.add_subparsers(dest="job", required=True, metavar="WHAT")
    merge = jobs.add_parser(
        "merge", parents=[common], help="merge several maps into one, or close the loops of one map",
        description="Merge several maps into one, or close the loops of one map.",
        epilog="example:\n  rse-pf batch run merge robot-1 robot-2 --out kitchen --store dir:objects",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    merge.add_argument(
        "names", nargs="+", metavar="MAP",
        help="MAP or MAP@VERSION; the world frame of the first is kept; a single map gets its loops closed",
    )  # fmt: skip
    merge.add_argument("--out", required=True, metavar="MAP", help="the map that gets a new version")
    merge.add_argument(
        "--workers", type=int, metavar="N",
        help=f"worker processes on this machine, 1 to {_MAX_WORKERS} (default: {_WORKERS})",
    )  # fmt: skip
    merge.add_argument(
        "--candidates", type=int, default=8, metavar="N", help="other keyframes tried for each"
    )
    merge.add_argument("--no-icp", action="store_true", help="do not align clouds")
    merge.add_argument(
        "--scheduler", metavar="ADDRESS",
        help="use the workers of the Dask scheduler at ADDRESS, not of this machine; they need the store",
    )  # fmt: skip
    merge.add_argument("--tenant", default="default", help="tenant of the maps (default: %(default)s)")
    merge.add_argument("--note", default="", help="note of the new version")
    merge.add_argument("--json", action="store_true", help="print JSON")
    actions.add_parser(
        "clean", parents=[common], help="delete the parts of runs that were not finished",
        description="Delete the parts of runs that were not finished; one that is under way fails then.",
        epilog="example:\n  rse-pf batch clean --store dir:objects",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Do one action and return the exit code."""
    chosen = settings if args.store is None else settings.replace(data={"store": args.store})
    if chosen.data.store == "memory:":
        folder = state_folder("default", os.environ) / "objects"
        raise UsageError(
            "no store is named, and one in memory belongs to another process",
            hint=f"name --store dir:PATH; that of rse-pf local is dir:{folder}",
        )
    kind, _, path = chosen.data.store.partition(":")
    if kind == "dir" and not os.path.isdir(path):
        raise UsageError(f"there is no folder {path}", hint="name the store that holds the maps")
    if kind == "dir":
        chosen = chosen.replace(data={"store": f"dir:{os.path.abspath(path)}"})
    if args.action == "clean":
        return _clean(open_data_store(chosen))
    require("batch run")
    return _merge(args, chosen)


def _merge(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Merge in parts; the exit code is 1 if a map was not joined."""
    from rse_pf.extensions.batch.cluster import Cluster, DaskEngine, LocalCluster, RemoteCluster
    from rse_pf.extensions.batch.merge import BatchMerge
    from rse_pf.services.mapping.merge import reply_of
    from rse_pf.slam.loop_closures import MergeOptions

    if args.scheduler is not None and args.workers is not None:
        raise UsageError(
            "--workers and --scheduler exclude each other", hint="the scheduler has workers of its own"
        )
    workers = _WORKERS if args.workers is None else args.workers
    if not 1 <= workers <= _MAX_WORKERS:
        raise UsageError(
            f"--workers {workers} is not within 1..{_MAX_WORKERS}", hint="choose one for each free core"
        )
    cluster: Cluster = LocalCluster(workers) if args.scheduler is None else RemoteCluster(args.scheduler)
    store = open_data_store(settings)

    def record(action: str, name: str, version: MapRecord) -> None:
        subject = str(RobotId(args.tenant, name))
        record_map_change(settings, action, subject, version=version.id, number=version.number)

    maps = MapRegistry(
        store, args.tenant, max_bytes=4 * settings.data.max_object_bytes, on_change=record
    )  # fmt: skip
    options = MergeOptions(candidates=args.candidates)
    inputs = [_object_of(word, maps) for word in args.names]
    parent = _id_of_head(args.out, maps)
    engine = DaskEngine(store, settings, cluster, on_event=lambda text: show(text, error=True))
    merge = BatchMerge(store, engine, settings, options=options, align_clouds=not args.no_icp)
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
    origin = MapOrigin(parent=parent, author="rse-pf batch run merge", created_s=time.time(), note=args.note)
    code = commit_merge(
        reply_of(result.merged), maps, args.names, into=args.out, origin=origin,
        json_fields=fields if args.json else None,
    )  # fmt: skip
    merge.forget()
    if not args.json:
        show(
            f"{'parts':<11} {result.computed} computed, {result.found} found; "
            f"{counted(len(result.tiles), 'link')} from aligned clouds; {seconds:.1f} s"
        )
    return code


def _clean(store: ObjectStore) -> int:
    from rse_pf.extensions.batch.parts import PREFIX

    names = [info.name for info in store.list(f"{PREFIX}/")]
    for name in names:
        store.delete(name)
    show(f"{counted(len(names), 'object')} deleted")
    return 0


def _object_of(word: str, maps: MapRegistry) -> str:
    """Return the object of ``MAP`` or ``MAP@VERSION``."""
    name, _, version = word.partition("@")
    return maps.blob_name(name, maps.record(name, version or "head"))


def _id_of_head(name: str, maps: MapRegistry) -> str | None:
    try:
        return maps.head(name).id
    except NotFound:
        return None
