"""Commit the result of a merge of maps and show it, for the verbs map and batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rse_pf.errors import CommandFailed
from rse_pf.maps.registry import MapOrigin, MapRegistry
from rse_pf.services.mapping.merge import MergeReply
from rse_pf.terminal import counted, show, show_json, show_progress

__all__ = ["commit_merge", "merge_progress"]


def commit_merge(
    reply: MergeReply,
    maps: MapRegistry,
    names: Sequence[str],
    *,
    into: str,
    origin: MapOrigin,
    json_fields: dict[str, Any] | None,
) -> int:
    """Commit the merged map as the next version of map *into*, and print which maps were joined.

    Returns the exit code: 1 if any map was not joined, else 0.

    Args:
        reply: Result of the merge.
        maps: The maps of the tenant, among which the version is committed.
        names: The maps that were merged as the user wrote them, in the order of the merge.
        into: Name of the map that gets the version.
        origin: Head before the merge, author, time, and the user's note; for an empty note the names of the
            joined maps are noted.
        json_fields: Further fields of the JSON that is printed; None prints text.

    Raises:
        CommandFailed: Several maps were merged and no two of them could be joined; nothing is written.
    """
    not_joined = [(names[failure.map], failure.reason) for failure in reply.not_joined]
    if len(names) > 1 and len(reply.joined) < 2:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in not_joined)
        raise CommandFailed(
            f"no two of these maps can be joined, so nothing was written: {reasons}",
            hint="record frames at places that another robot has seen, then merge again",
        )
    joined = [names[row] for row in reply.joined]
    version = maps.commit(
        into, reply.map, parent=origin.parent, author=origin.author, created_s=origin.created_s,
        note=origin.note or f"merged {', '.join(joined)}",
    )  # fmt: skip
    refused = _refused(names, reply)
    if json_fields is not None:
        plain = {
            "name": into, "id": version.id, "number": version.number, "joined": joined,
            "not_joined": [{"map": name, "reason": reason} for name, reason in not_joined],
            "refused": refused, "links": reply.merges, "loops": reply.loops, **json_fields,
        }  # fmt: skip
        show_json(plain, indent=2, sort_keys=True)
        return 1 if not_joined else 0
    show(
        f"{into} is now version {version.number}, {version.id[:12]}: "
        f"{counted(version.keyframes, 'keyframe')}, {counted(version.points, 'point')}, "
        f"{counted(reply.merges, 'loop closure')} between maps, "
        f"{counted(reply.loops, 'loop closure')} within maps",
        _row("joined", ", ".join(joined)),
        *(_row("not joined", f"{name}: {reason}") for name, reason in not_joined),
        *(
            _row(
                "rejected",
                f"{each['between']}: " + ", ".join(f"{n} {why}" for why, n in each["reasons"].items()),
            )
            for each in refused
        ),
    )
    return 1 if not_joined else 0


def merge_progress(done: float, what: str) -> None:
    """Show on the terminal that the part *done* of a merge (0 to 1) is done, and its present step *what*."""
    show_progress(f"{100 * done:3.0f} %  {what}", is_over=done >= 1.0)


def _refused(names: Sequence[str], reply: MergeReply) -> list[dict[str, Any]]:
    """Return, for each pair of maps, how many pairs of their keyframes were rejected for each reason."""
    pairs: dict[str, dict[str, int]] = {}
    for refusal in reply.refused:
        between = " and ".join(dict.fromkeys(names[row] for row in refusal.maps))
        if len(set(refusal.maps)) == 1:
            between = f"within {between}"
        pairs.setdefault(between, {})[refusal.reason] = refusal.count
    return [{"between": between, "reasons": reasons} for between, reasons in pairs.items()]


def _row(name: str, value: object) -> str:
    return f"{name:<11} {value}"
