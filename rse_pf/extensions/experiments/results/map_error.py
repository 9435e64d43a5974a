"""The accuracy of a merged map: the trajectories of its robots, and their errors against the truth.

The truth is used for errors only; the report names the robots that are not in the map.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from client_sdk.trajectory import Trajectory
from client_sdk.trajectory_error import matched_poses, residuals_m, rms
from rse_pf.extensions.experiments.results.markdown import table
from rse_pf.geometry import Array, inverse, pose_difference
from rse_pf.maps.format import MapVersion
from rse_pf.services.mapping.merge import MergeReply
from rse_pf.terminal import counted

__all__ = ["JoinedRobot", "joined_robots", "merge_section", "merged_lines", "merged_table", "move_frames"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JoinedRobot:
    """A robot in the merged map: its trajectory in its own frame, in the map's frame, and the true one."""

    name: str
    own: Trajectory
    merged: Trajectory
    truth: Trajectory | None


def joined_robots(
    names: Sequence[str],
    paths: Sequence[Trajectory],
    truths: Sequence[Trajectory | None],
    versions: Sequence[MapVersion],
    reply: MergeReply,
    merged: MapVersion,
) -> list[JoinedRobot]:
    """Return the robots that are in the merged map, with the pose of every frame in that map.

    Args:
        names: Names of the robots, in the order in which their maps were sent.
        paths: Poses of all frames, each in the world frame of its robot.
        truths: True poses, in one common world frame, where known.
        versions: The maps that were sent.
        reply: Reply of the merge service.
        merged: The map of *reply*; its provenance says which robot each keyframe is from.
    """
    poses: dict[tuple[int, int], Array] = {
        (int(owner), int(number)): keyframe.T_world_camera
        for (owner, number), keyframe in zip(merged.provenance["from"], merged.keyframes, strict=True)
    }
    robots = []
    for row in reply.joined:
        keyframes = versions[row].keyframes
        moved = move_frames(
            paths[row],
            np.array([keyframe.timestamp_s for keyframe in keyframes]),
            np.array([keyframe.T_world_camera for keyframe in keyframes]),
            np.array([poses[row, keyframe.id] for keyframe in keyframes]),
        )
        robots.append(JoinedRobot(name=names[row], own=paths[row], merged=moved, truth=truths[row]))
    return robots


def move_frames(path: Trajectory, stamps_s: Array, T_before: Array, T_after: Array) -> Trajectory:
    """Return *path* with its poses corrected as an optimisation has corrected its keyframes.

    The correction of a frame between two keyframes is interpolated by time; a frame before the first or after
    the last keyframe gets the correction of that keyframe.

    Args:
        path: ``n`` poses ``T_world_camera``, in the world frame of *T_before*.
        stamps_s: ``(k,)``, time stamps of the keyframes, ascending.
        T_before: ``(k, 4, 4)``, poses of the keyframes before the optimisation.
        T_after: ``(k, 4, 4)``, poses of the keyframes after it, in the world frame of the result.
    """
    corrections = T_after @ np.array([inverse(T) for T in T_before])
    after = np.clip(np.searchsorted(stamps_s, path.timestamps_s, side="right"), 0, len(stamps_s) - 1)
    before = np.clip(np.searchsorted(stamps_s, path.timestamps_s, side="right") - 1, 0, len(stamps_s) - 1)
    gap_s = stamps_s[after] - stamps_s[before]
    share = np.clip((path.timestamps_s - stamps_s[before]) / np.where(gap_s > 0, gap_s, 1.0), 0.0, 1.0)
    first, second = (corrections[rows] @ path.T_world_camera for rows in (before, after))
    mean = (1.0 - share)[:, None, None] * first + share[:, None, None] * second
    U, _, Vt = np.linalg.svd(mean[:, :3, :3])  # the rotation nearest to the mean of two similar ones
    mean[:, :3, :3] = U @ Vt
    return Trajectory(path.timestamps_s, mean)


def merge_section(
    names: Sequence[str],
    robots: Sequence[JoinedRobot],
    reply: MergeReply,
    merged: MapVersion,
    origin: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the member ``merged`` of ``report.json``, the figures of a merged map.

    ``ate_cm`` is the ATE of all frames of the joined robots after one rigid alignment of all robots to the
    truth. ``ate_before_cm`` is the ATE before the merge: since the relative poses of the robots are unknown
    then, each robot is aligned by itself, so that only its drift counts.  ``ate_stiff_cm`` is the ATE of the
    maps moved rigidly to their poses in the merged map, without the optimisation.  ``origins`` is the error
    of each robot's first pose relative to that of the first robot.
    """
    return {
        "joined": [names[row] for row in reply.joined],
        "not_joined": [
            {"robot": names[refusal.map], "reason": refusal.reason} for refusal in reply.not_joined
        ],
        "refused": [
            {"robots": [names[row] for row in refusal.maps], "reason": refusal.reason, "count": refusal.count}
            for refusal in reply.refused
        ],
        "loop_closures_between_robots": reply.merges,
        "loops": reply.loops,
        "keyframes": len(merged.keyframes),
        "points": len(merged.points),
        "frames": sum(len(robot.own) for robot in robots),
        **_errors(robots),
        **origin,
    }


def merged_lines(section: Mapping[str, Any]) -> str:
    """Return the lines about a merged map for the terminal, each with a newline.

    *section* is the result of `merge_section`.
    """
    joined = section["joined"]
    what = (
        f"{counted(section['loop_closures_between_robots'], 'loop closure')} between robots "
        f"and {section['loops']} within robots"
        if len(joined) > 1
        else counted(section["loops"], "loop closure")
    )
    lines = [f"merged {', '.join(joined)}: {counted(section['keyframes'], 'keyframe')}, {what}"]
    if section["ate_cm"] is not None:
        alone = ", each robot aligned to the truth by itself, which is easier" if len(joined) > 1 else ""
        together = ", all robots aligned to the truth as one" if len(joined) > 1 else ""
        lines.append(
            f"ATE {section['ate_cm']:.2f} cm in the merged map{together} "
            f"(before: {section['ate_before_cm']:.2f} cm{alone})"
        )
    lines += [f"{entry['robot']} not joined: {entry['reason']}" for entry in section["not_joined"]]
    reasons = Counter[str]()
    for refusal in section["refused"]:
        reasons[refusal["reason"]] += refusal["count"]
    if reasons:
        counts = ", ".join(f"{count} {reason}" for reason, count in sorted(reasons.items()))
        pairs = (
            "1 pair of keyframes was"
            if reasons.total() == 1
            else f"{reasons.total()} pairs of keyframes were"
        )
        lines.append(f"{pairs} rejected as loop closures ({counts})")
    return "".join(f"{line}\n" for line in lines)


def merged_table(section: Mapping[str, Any]) -> list[str]:
    """Return the lines of the Markdown table about a merged map; *section* is that of `merge_section`."""
    rejected: dict[str, list[str]] = defaultdict(list)
    for refusal in section["refused"]:
        first, other = refusal["robots"]
        pair = f"within {first}" if first == other else f"between {first} and {other}"
        rejected[pair].append(f"{refusal['count']} {refusal['reason']}")
    errors = [
        (what, "-" if section[name] is None else f"{section[name]:.2f}")
        for what, name in (
            ("ATE cm", "ate_cm"),
            ("ATE cm before the merge, each robot aligned to the truth by itself", "ate_before_cm"),
            ("ATE cm of the maps moved rigidly, not optimised", "ate_stiff_cm"),
        )
    ]
    counts = [str(section[name]) for name in ("keyframes", "loop_closures_between_robots", "loops")]
    rows = [
        ("joined", ", ".join(section["joined"])),
        ("not joined", "; ".join(f"{e['robot']}: {e['reason']}" for e in section["not_joined"]) or "-"),
        ("keyframes / loop closures between robots / within robots", " / ".join(counts)),
        *errors,
        *((f"error of the origin of {origin['robot']}", f"{origin['cm']:.1f} cm, {origin['deg']:.2f} deg")
          for origin in section["origins"]),
        *((f"rejected loop closures {pair}", ", ".join(reasons)) for pair, reasons in rejected.items()),
    ]  # fmt: skip
    return table(["merged map", ""], rows)


def _errors(robots: Sequence[JoinedRobot]) -> dict[str, Any]:
    pairs = [_match_poses(robot) for robot in robots]
    if not robots or any(pair is None for pair in pairs):
        return {"ate_cm": None, "ate_before_cm": None, "ate_stiff_cm": None, "origins": []}
    known = [pair for pair in pairs if pair is not None]
    together = residuals_m(
        np.concatenate([merged[:, :3, 3] for _, merged, _ in known]),
        np.concatenate([truth[:, :3, 3] for _, _, truth in known]),
    )
    stiff = residuals_m(
        np.concatenate([(_rigid_motion(own, merged) @ own)[:, :3, 3] for own, merged, _ in known]),
        np.concatenate([truth[:, :3, 3] for _, _, truth in known]),
    )
    before = np.concatenate([residuals_m(own[:, :3, 3], truth[:, :3, 3]) for own, _, truth in known])
    _, first, first_truth = known[0]
    origins = []
    for robot, (_, merged, truth) in zip(robots[1:], known[1:], strict=True):
        off_m, off_deg = pose_difference(inverse(first[0]) @ merged[0], inverse(first_truth[0]) @ truth[0])
        origins.append({"robot": robot.name, "cm": round(100 * off_m, 3), "deg": round(off_deg, 3)})
    return {
        "ate_cm": round(100 * rms(together), 4),
        "ate_before_cm": round(100 * rms(before), 4),
        "ate_stiff_cm": round(100 * rms(stiff), 4),
        "origins": origins,
    }


def _match_poses(robot: JoinedRobot) -> tuple[Array, Array, Array] | None:
    """Return the own, merged and true poses ``(n, 4, 4)`` of the frames that have a truth.

    None if fewer than three frames have one.
    """
    matched = matched_poses(robot.merged, robot.truth)
    if matched is None:
        return None
    rows, true_poses = matched
    return robot.own.T_world_camera[rows], robot.merged.T_world_camera[rows], true_poses


def _rigid_motion(own: Array, merged: Array) -> Array:
    """Return the rigid motion ``(4, 4)`` that maps the poses *own* ``(n, 4, 4)`` closest to *merged*.

    Its rotation is the mean of the relative rotations, and its translation the mean of the remaining
    differences.
    """
    U, _, Vt = np.linalg.svd((merged[:, :3, :3] @ np.swapaxes(own[:, :3, :3], 1, 2)).sum(axis=0))
    T = np.eye(4)
    T[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    T[:3, 3] = (merged[:, :3, 3] - own[:, :3, 3] @ T[:3, :3].T).mean(axis=0)
    return T
