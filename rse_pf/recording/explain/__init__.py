"""Why a pose is bad: pure functions from what was recorded to causes, likeliest first.

Nothing is read, written or drawn here; the same input gives the same explanation.
"""

from rse_pf.recording.explain.causes import (
    Cause,
    MatchesLike,
    PastCommand,
    PoseExplanation,
    ReplyLike,
    Timing,
)
from rse_pf.recording.explain.ranking import explain

__all__ = ["Cause", "MatchesLike", "PastCommand", "PoseExplanation", "ReplyLike", "Timing", "explain"]
