"""The end of a demo with --merge: the robots' maps become one, with its picture, its cloud and its score.

Promises that the robots' own maps stay as they were, and that a map which was not joined is not drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from client_sdk.mapping import Trajectory, write_ply, write_trajectory
from rse_pf.errors import CommandFailed
from rse_pf.experiments.demo.keyframes import MAP_FILE
from rse_pf.experiments.plots.map_image import PathOfRobot, draw_map
from rse_pf.experiments.results.map_error import JoinedRobot, joined_robots, merge_section
from rse_pf.maps.format import MapVersion, decode_map
from rse_pf.services.mapping.merge import MergeReply

__all__ = ["MERGED_MAP", "Merging", "write_merged"]

MERGED_MAP = "merged.rsemap"

Merging = Callable[[Sequence[bytes]], tuple[MergeReply, dict[str, Any]]]
"""Merges encoded maps, wherever; returns the reply of ``merge``, and what the report says of the asking."""


def write_merged(
    folder: Path,
    names: Sequence[str],
    paths: Sequence[Trajectory],
    truths: Sequence[Trajectory | None],
    ask: Merging,
) -> dict[str, Any]:
    """Merge the maps in the robots' folders, write what came of it, and return ``merged`` of the report.

    Writes ``merged.rsemap``, ``merged.ply``, ``map_merged.png``, and ``merged_trajectory.txt`` in the folder
    of every robot that was joined.

    Args:
        folder: The demo's; each robot has a folder of its name in it.
        names: Of the robots; the first one's world becomes that of the map.
        paths: Where they went, each in its own world.
        truths: Where they really went, in one world, where known.
        ask: Who merges.

    Raises:
        CommandFailed: A robot made no keyframe.
        MissingExtra: The extra "maps" is not installed where the merge runs.
    """
    encoded = [(folder / name / MAP_FILE).read_bytes() for name in names]
    versions = [decode_map(data) for data in encoded]
    empty = [name for name, version in zip(names, versions, strict=True) if not version.keyframes]
    if empty:
        raise CommandFailed(
            f"{empty[0]} made no keyframe, so there is nothing to merge", hint="give it more frames"
        )
    reply, how = ask(encoded)
    merged = decode_map(reply.map)
    robots = joined_robots(names, paths, truths, versions, reply, merged)
    (folder / MERGED_MAP).write_bytes(reply.map)
    write_ply(folder / "merged.ply", merged.points, merged.colours)
    for robot in robots:
        write_trajectory(folder / robot.name / "merged_trajectory.txt", robot.merged)
    section = merge_section(names, robots, reply, merged, how)
    _draw(folder / "map_merged.png", robots, merged, section)
    return section


def _draw(path: Path, robots: Sequence[JoinedRobot], merged: MapVersion, section: dict[str, Any]) -> None:
    who = f"{len(robots)} robots" if len(robots) > 1 else "1 robot"
    caption = f"{who} in one map: {section['keyframes']} keyframes"
    caption += f", {section['links_between_robots']} links" if len(robots) > 1 else ""
    if section["ate_cm"] is not None:
        caption += f", ATE {section['ate_cm']:.1f} cm"
    if section["not_joined"]:
        caption += f"; not joined: {', '.join(each['robot'] for each in section['not_joined'])}"
    shown = [PathOfRobot(name=each.name, T_world_camera=each.merged.T_world_camera) for each in robots]
    draw_map(path, merged.points, merged.colours, shown, caption)
