"""Counts of the images that a bridge does not use, by reason, and the sentence about them for its status.

A fault is input that contradicts itself, such as a camera_info that changes: the status of the bridge names
it for 5 s.  Images that arrived too late or too fast are named only if more than half of the images are left
out.
"""

from __future__ import annotations

from collections import Counter, deque

__all__ = ["InputCheck"]

# Number of status reports, 1 s apart, that name a fault: long enough for a user to read it.
STATUS_REPORTS = 5


class InputCheck:
    """Counts unused images by reason: ``left_out`` since the start, all else over the last 5 reports."""

    def __init__(self) -> None:
        self.left_out: Counter[str] = Counter()
        self._fault = ""
        self._fault_age = 0
        self._sentence = ""
        self._now: Counter[str] = Counter()
        self._recent: deque[Counter[str]] = deque(maxlen=STATUS_REPORTS)

    @property
    def fault(self) -> str:
        """The newest fault within the last `STATUS_REPORTS` reports; empty if there was none."""
        return self._fault if self._fault_age < STATUS_REPORTS else ""

    @property
    def shortage(self) -> str:
        """The sentence with the number of unused colour images, if more than half were unused; else empty."""
        recent = sum(self._recent, Counter(self._now))
        if 2 * recent["left out"] <= recent["received"]:
            return ""
        return f"{recent['left out']} of {recent['received']} images were left out: {self._sentence}"

    def count_colour(self) -> None:
        """Count a colour image that was received."""
        self._now["received"] += 1

    def leave_out(self, reason: str, sentence: str = "", *, colours: int = 1, partners: int = 0) -> None:
        """Count images that are not used although they are valid.

        Args:
            reason: Key of the count.
            sentence: Text for the status; empty for *reason*.
            colours: Number of colour images.
            partners: Number of depth or right images.
        """
        self.left_out[reason] += colours + partners
        if colours:
            self._now["left out"] += colours
            self._sentence = sentence or reason

    def refuse(self, reason: str, fault: str) -> None:
        """Count a message that is not used because it is invalid, and report *fault* in the status."""
        self.left_out[reason] += 1
        self.note(fault)

    def note(self, fault: str) -> None:
        """Report *fault* in the status, without counting a message."""
        self._fault, self._fault_age = fault, 0

    def next_report(self) -> None:
        """Start the counts of the next status report."""
        self._recent.append(self._now)
        self._now = Counter()
        self._fault_age += 1
