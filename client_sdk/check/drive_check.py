"""The check of a drive beside what makes a map of it: it costs little, and never fails that."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

from client_sdk.source_facts import doubt_line

if TYPE_CHECKING:
    from client_sdk.check.motion import MotionReference
    from client_sdk.check.observer import DriveObserver
    from client_sdk.frontend import Frame, TrackedFrame
    from client_sdk.source_facts import Doubt
    from client_sdk.tracking.stereo_adjustment import StereoAdjustment

__all__ = ["DriveCheck", "check_lines"]

_T = TypeVar("_T")


def check_lines(told: Mapping[str, Any], *, is_whole: bool = False, shown: Collection[str] = ()) -> list[str]:
    """Return a report for people: each finding with its fix.

    *is_whole* adds cost and what cannot be told; doubts whose lines were *shown* before are left out.
    """
    findings: Sequence[Mapping[str, Any]] = told.get("findings") or []
    untold: Sequence[Mapping[str, Any]] = told.get("cannot_tell") or []
    lines = []
    for each in findings:
        cost = each.get("cost")
        bends = "" if cost is None else f"; it bends the path by about {100 * cost:.1f} cm"
        lines.append(f"check: {each.get('sentence')}{bends}; {each.get('fix')}")
    kinds = sorted({str(each.get("kind")) for each in untold})
    doubts: Sequence[Mapping[str, Any]] = told.get("source") or []
    lines += [line for each in doubts if (line := doubt_line(each)) not in shown]
    if doubts:
        lines.append(
            "check: no advice on the calibration while the source has a finding that is not accepted"
        )
    elif told.get("poses") == 0:
        lines.append(f"check: none of {told.get('frames')} frames got a pose: the calibration is not checked")
    elif not findings:
        vague = "" if is_whole or not kinds else f"; this drive cannot tell {', '.join(kinds)}"
        lines.append(f"check: nothing wrong found in {told.get('frames')} frames{vague}")
    if is_whole:
        lines += [f"cannot tell {each.get('kind')}: {each.get('reason')}" for each in untold]
        lines += [f"note: {each}" for each in told.get("notes") or []]
    return lines


class DriveCheck:
    """A `DriveObserver` whose errors end the check and nothing else."""

    def __init__(self, *, is_wanted: bool, is_thinned: bool = False) -> None:
        self._observer: DriveObserver | None = None
        self._failed = ""
        if is_wanted:
            self._observer = self._tried(lambda: _observer(is_thinned=is_thinned))

    @property
    def is_wanted(self) -> bool:
        """Whether it goes on: it is wanted, and had no error."""
        return self._observer is not None

    def add(self, frame: Frame, tracked: TrackedFrame) -> None:
        """Look at the next frame."""
        observer = self._observer
        if observer is not None:
            self._tried(lambda: observer.add(frame, tracked))

    def cause_of_loss(self) -> str | None:
        """Return why most lost frames have no pose, if their images show it and are checked."""
        observer = self._observer
        return None if observer is None else self._tried(observer.cause_of_loss)

    def finish(
        self,
        reference: MotionReference | None = None,
        offsets: Mapping[int, StereoAdjustment] | None = None,
        doubts: Sequence[Doubt] = (),
        accepted: Iterable[str] = (),
    ) -> dict[str, Any] | None:
        """Return what ``report.json`` holds of the check; None if it was not wanted.

        *offsets* are what `Mapper.adjust_pairs` found in a stereo drive; *doubts* about the source are not
        among the names that the user has *accepted*.
        """
        observer = self._observer
        if observer is not None:
            observer.reference = reference
            observer.add_offsets(offsets or {})
            report = self._tried(lambda: observer.finish(doubts, accepted))
            if report is not None:
                return report.to_dict()
        return {"failed": self._failed} if self._failed else None

    @staticmethod
    def lines(told: Mapping[str, Any] | None, shown: Collection[str] = ()) -> list[str]:
        """Return the short form of what `finish` returned, without doubts that were *shown* before."""
        if told is None:
            return []
        failed = told.get("failed")
        return (
            [f"check: it failed ({failed}); --no-check leaves it out"]
            if failed
            else check_lines(told, shown=shown)
        )

    def _tried(self, work: Callable[[], _T]) -> _T | None:
        try:
            return work()
        except Exception as error:  # noqa: BLE001  a check must not cost the map that was driven
            self._failed = f"{type(error).__name__}: {error}".splitlines()[0][:200]
            self._observer = None
            return None


def _observer(*, is_thinned: bool) -> DriveObserver:
    # What a check needs is imported where one is wanted.
    from client_sdk.check.observer import DriveObserver

    return DriveObserver(is_thinned=is_thinned)
