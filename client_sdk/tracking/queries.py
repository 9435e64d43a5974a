"""One query at a time: the steps of a frame are a generator that yields queries and gets their answers.

What is asked, and what an answer means, is decided by the trackers.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

from client_sdk.frontend import PoseQuery, TrackedFrame
from rse_pf.errors import UsageError
from rse_pf.geometry import Array

__all__ = ["Answer", "OneQuery", "Steps"]


@dataclass(frozen=True, slots=True)
class Answer:
    """The pose of the camera in the query's frame, or None; how many agree; and whether it is weak."""

    T_camera_world: Array | None
    inliers: int
    is_weak: bool


Steps = Generator[PoseQuery, Answer, TrackedFrame]


class OneQuery:
    """The steps of the present frame, and its open query."""

    def __init__(self) -> None:
        self._steps: Steps | None = None
        self._query: PoseQuery | None = None

    def refuse_open(self) -> None:
        """Raise UsageError if a query is open."""
        if self._query is not None:
            raise UsageError(
                f"the query of frame {self._query.timestamp_s:.3f} s is open",
                hint="call accept with its answer, or with None",
            )

    def begin(self, steps: Steps) -> PoseQuery | TrackedFrame:
        """Return the first query of a frame, or its result if it needs none."""
        self._steps = steps
        return self._advance(None)

    def answer(self, query: PoseQuery, answer: Answer) -> PoseQuery | TrackedFrame:
        """Return the next query, or the result; raises UsageError if *query* is not the open one."""
        if query is not self._query:
            raise UsageError("this query is not the open one", hint="answer each query once, in order")
        self._query = None
        return self._advance(answer)

    def _advance(self, answer: Answer | None) -> PoseQuery | TrackedFrame:
        assert self._steps is not None
        try:
            self._query = next(self._steps) if answer is None else self._steps.send(answer)
        except StopIteration as end:
            self._steps = None
            result: TrackedFrame = end.value
            return result
        return self._query
