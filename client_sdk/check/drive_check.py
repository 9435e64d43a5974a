"""Check a drive while a map is made of it; an error of the check never stops the map.

Also formats the result of a check as lines of text.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

from client_sdk.check.observer import DriveObserver
from client_sdk.source_facts import doubt_line

if TYPE_CHECKING:
    from client_sdk.check.motion import MotionReference
    from client_sdk.frontend import Frame, TrackedFrame
    from client_sdk.mapper import Mapper
    from client_sdk.source_facts import Doubt

__all__ = ["DriveCheck", "check_lines"]

_T = TypeVar("_T")


def check_lines(
    report: Mapping[str, Any], *, is_whole: bool = False, shown: Collection[str] = ()
) -> list[str]:
    """Return the result of a check as lines of text: one line for each finding, with the action against it.

    Args:
        report: The result, as `CheckReport.to_dict` returns it.
        is_whole: Whether to add the faults that the drive cannot show, with reasons, and the notes.
        shown: Lines of doubts about the source that were printed before; they are left out.
    """
    findings: Sequence[Mapping[str, Any]] = report.get("findings") or []
    undetermined: Sequence[Mapping[str, Any]] = report.get("cannot_tell") or []
    lines = []
    for each in findings:
        cost = each.get("cost")
        bends = "" if cost is None else f"; it bends the path by about {100 * cost:.1f} cm"
        lines.append(f"check: {each.get('sentence')}{bends}; {each.get('fix')}")
    kinds = sorted({str(each.get("kind")) for each in undetermined})
    doubts: Sequence[Mapping[str, Any]] = report.get("source") or []
    lines += [line for each in doubts if (line := doubt_line(each)) not in shown]
    if doubts:
        lines.append(
            "check: no advice on the calibration while the source has a finding that is not accepted"
        )
    elif report.get("poses") == 0:
        lines.append(
            f"check: none of {report.get('frames')} frames got a pose: the calibration is not checked"
        )
    elif not findings:
        vague = "" if is_whole or not kinds else f"; this drive does not determine {', '.join(kinds)}"
        lines.append(f"check: nothing wrong found in {report.get('frames')} frames{vague}")
    if is_whole:
        lines += [f"{each.get('kind')} is not determined: {each.get('reason')}" for each in undetermined]
        lines += [f"note: {each}" for each in report.get("notes") or []]
    return lines


class DriveCheck:
    """Run a `DriveObserver` while a map is made.

    The first exception of the observer stops the check, and is reported in its result instead of raised.
    """

    def __init__(self, *, is_thinned: bool = False) -> None:
        self._failed = ""
        self._observer = self._tried(lambda: DriveObserver(is_thinned=is_thinned))

    def add(self, frame: Frame, tracked: TrackedFrame) -> None:
        """Pass the next frame and the result of tracking it to the observer, if the check still runs."""
        observer = self._observer
        if observer is not None:
            self._tried(lambda: observer.add(frame, tracked))

    def cause_of_loss(self) -> str | None:
        """Return why most frames without a pose were lost, and what to do.

        None if their images do not show the cause, or if the check does not run.
        """
        observer = self._observer
        return None if observer is None else self._tried(observer.cause_of_loss)

    def finish(
        self,
        mapper: Mapper | None = None,
        reference: MotionReference | None = None,
        doubts: Sequence[Doubt] = (),
        accepted: Iterable[str] = (),
    ) -> dict[str, Any]:
        """Check the whole drive, and return the result as ``report.json`` stores it.

        A check that an error stopped returns ``{"failed": message}``.

        Args:
            mapper: Tracked the drive; its stereo pairs are adjusted, which may change its keyframes.  None
                without such pairs.
            reference: The path that the motion of the camera is compared with.
            doubts: Doubts about the source that the user has not accepted.
            accepted: Names of doubts that the user has accepted.
        """
        observer = self._observer
        if observer is not None:
            observer.reference = reference
            observer.add_offsets({} if mapper is None else mapper.adjust_pairs())
            report = self._tried(lambda: observer.finish(doubts, accepted))
            if report is not None:
                return report.to_dict()
        return {"failed": self._failed}

    @staticmethod
    def lines(report: Mapping[str, Any], shown: Collection[str] = ()) -> list[str]:
        """Return short lines of text for *report*, the result of `finish`.

        Doubts whose lines were *shown* before are left out.
        """
        failed = report.get("failed")
        return (
            [f"check: it failed ({failed}); --no-check leaves it out"]
            if failed
            else check_lines(report, shown=shown)
        )

    def _tried(self, work: Callable[[], _T]) -> _T | None:
        try:
            return work()
        except Exception as error:  # noqa: BLE001  a check must not cost the map that was driven
            self._failed = f"{type(error).__name__}: {error}".splitlines()[0][:200]
            self._observer = None
            return None
