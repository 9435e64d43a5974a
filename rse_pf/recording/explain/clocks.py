"""Late frames and late answers: how old a pose was when the robot could use it."""

from __future__ import annotations

from rse_pf.recording.explain.causes import Cause, PoseExplanation, Timing

__all__ = ["late"]

_DEFAULT_PERIOD_S = 0.2
_PERIODS = 1.25
_LEAST_ALLOWED_S = 0.1
# A robot's clock may differ from itself by this much between two threads that stamp.
_EARLY_S = 0.005


def late(timing: Timing | None) -> tuple[PoseExplanation | None, tuple[str, ...]]:
    """Return the explanation where the frame or the answer was late, and which times were missing."""
    if timing is None:
        return None, ("times (they would show a late frame or a late answer)",)
    missing = []
    allowed_s = max(_LEAST_ALLOWED_S, _PERIODS * (timing.period_s or _DEFAULT_PERIOD_S))
    candidates: list[tuple[float, str, dict[str, float]]] = []
    if timing.sent_s is None:
        missing.append("the time of sending (it would show a late frame or a late answer)")
    elif timing.frame_s is None:
        missing.append("the stamp of the frame (it would show a late frame)")
    else:
        age_s = timing.sent_s - timing.frame_s
        if age_s > allowed_s:
            candidates.append((
                age_s / allowed_s,
                f"the frame was {_ms(age_s)} old when it was sent, and at most {_ms(allowed_s)} are usual: "
                "the camera's clock or the robot's queue is late",
                {"frame_age_s": age_s, "allowed_s": allowed_s},
            ))  # fmt: skip
        elif age_s < -_EARLY_S:
            candidates.append((
                1.0 - age_s / allowed_s,
                f"the frame is stamped {_ms(-age_s)} after it was sent: the clock of the camera is not that "
                "of the robot",
                {"frame_age_s": age_s, "allowed_s": allowed_s},
            ))  # fmt: skip
    if timing.answered_s is None:
        missing.append("the arrival of the answer (it would show a late answer)")
    elif timing.sent_s is not None:
        candidates += _late_answer(timing, timing.answered_s - timing.sent_s, allowed_s)
    if not candidates:
        return None, tuple(missing)
    strength, sentence, evidence = max(candidates, key=lambda each: each[0])
    explanation = PoseExplanation(
        cause=Cause.LATE, confidence=min(0.97, 0.75 + 0.08 * strength), sentence=sentence, evidence=evidence
    )
    return explanation, tuple(missing)


_Found = tuple[float, str, dict[str, float]]


def _late_answer(timing: Timing, trip_s: float, allowed_s: float) -> list[_Found]:
    limit_s = allowed_s if timing.deadline_s is None else min(allowed_s, timing.deadline_s)
    if trip_s <= limit_s:
        return []
    where = ""
    evidence = {"round_trip_s": trip_s, "allowed_s": limit_s}
    if timing.received_s is not None and timing.replied_s is not None:
        inside_s = timing.replied_s - timing.received_s
        evidence["in_the_server_s"] = inside_s
        where = f", {_ms(inside_s)} of them in the server"
    sentence = f"the answer took {_ms(trip_s)}{where}; {_ms(limit_s)} were allowed"
    return [(trip_s / limit_s, sentence, evidence)]


def _ms(seconds: float) -> str:
    return f"{1000 * seconds:.0f} ms"
