"""Which images a bridge leaves out and why, and the sentence for its status.

A fault is input that contradicts itself, such as a camera_info that changes: the status names it for some
seconds.  Images that only came too late or too fast are named where most of them are left out.
"""

from __future__ import annotations

from collections import Counter, deque

__all__ = ["InputCheck"]

STATUS_REPORTS = 5  # reports, 1 s apart: the status names a fault of one image long enough to be read


class InputCheck:
    """Count left-out images by reason; ``left_out`` is since the start, all else of the last reports."""

    def __init__(self) -> None:
        self.left_out: Counter[str] = Counter()
        self._fault = ""
        self._fault_age = 0
        self._sentence = ""
        self._now: Counter[str] = Counter()
        self._recent: deque[Counter[str]] = deque(maxlen=STATUS_REPORTS)

    @property
    def fault(self) -> str:
        """The newest fault of the last reports; empty if there was none."""
        return self._fault if self._fault_age < STATUS_REPORTS else ""

    @property
    def shortage(self) -> str:
        """How many colour images of the last reports were left out, if most of them were; else empty."""
        recent = sum(self._recent, Counter(self._now))
        if 2 * recent["left out"] <= recent["received"]:
            return ""
        return f"{recent['left out']} of {recent['received']} images were left out: {self._sentence}"

    def count_colour(self) -> None:
        """Count a colour image that was received."""
        self._now["received"] += 1

    def leave_out(self, reason: str, *, sentence: str = "", colours: int = 1, partners: int = 0) -> None:
        """Count images that are left out though nothing is wrong with them; *sentence* says more."""
        self.left_out[reason] += colours + partners
        if colours:
            self._now["left out"] += colours
            self._sentence = sentence or reason

    def refuse(self, reason: str, fault: str) -> None:
        """Count a message that is left out since it cannot be right."""
        self.left_out[reason] += 1
        self.note(fault)

    def note(self, fault: str) -> None:
        """Take a fault of input that is used all the same."""
        self._fault, self._fault_age = fault, 0

    def next_report(self) -> None:
        """Begin the counts of the next report."""
        self._recent.append(self._now)
        self._now = Counter()
        self._fault_age += 1
