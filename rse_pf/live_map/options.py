"""The numbers of a live map; ``python -m benchmarks live.one_process`` measures what they give."""

from __future__ import annotations

from dataclasses import dataclass, field

from rse_pf.errors import ConfigurationError
from rse_pf.slam.consistency import OdometryNoise, StrongLink
from rse_pf.slam.relative_pose import RelativePoseOptions

__all__ = ["LiveMapOptions"]


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveMapOptions:
    """How a live map decides; an owner never changes them while a map lives.

    Attributes:
        min_links: Two components are joined by so many links that agree pairwise, parts of a link added up.
        min_ends: From so many different keyframes on both sides.
        tested_links: At most so many links of a pair of components are compared, the newest.
        links_of_keyframe: At most so many of them may share a keyframe.
        spacing_m: Odometry noise is stated for steps of this length; it grows with the root of the way.
        spacing_deg: Odometry noise is stated for steps of this rotation, too.
        drift: Of odometry in the graph.
        judged: Of odometry when links are compared: larger, since a true link must not be refused.
        cauchy: Width of the robust kernel on links, in standard deviations.
        windows: Numbers of keyframes that the smoother moves; the next larger one is taken if the border of
            the window would move by more than ``border_m`` or ``border_deg``.
        smoothing_each: Keyframes in windows that a robot's keyframe may cause on average; what it causes
            beyond that adds up over all of its segments.
        smoothing_most: From this sum on, only the smallest window is taken for the robot.
        told_m: A correction is told if the alignment moved by at least this length.
        told_deg: A correction is told if the alignment turned by at least this angle.
        told_scale: A correction is told if the logarithm of the scale changed by at least this.
        doubts: A link that contradicts the graph in so many updates is removed.
        open_links: So many links that are not believed are kept, the newest.
        measured: What a measured relative pose needs to become a link.
        strong: From where on it counts whole.  Others count in part, and are believed only where none that
            counts whole ties the same keyframe to the same segment.
        candidates: So many keyframes are compared with a new one.
        apart_steps: Keyframes of one segment that are closer than this along the way are no loop.
        vague_steps: Beyond so many steps the graph is too vague to confirm a single link.
        same_place_m: Keyframes are of one place if they are closer than this.
        same_place_deg: Keyframes of one place differ by less than this rotation.
        same_place_most: Keyframes of one place beyond this number are redundant.
        lookalike_m: Two places that look the same are told apart from this distance on.
        lookalike_most_m: What is nearer to them than this may look like something else, too.
        lookalike_links: So many links that agree prove it between two robots, against believed ones.
        worst_drift: Share of the way that odometry may be wrong by; beyond it, a place is another one.
        optimise_every: A whole optimisation is wanted at most once in so many keyframes.
    """

    min_links: float = 3.0
    min_ends: int = 2
    tested_links: int = 48
    links_of_keyframe: int = 4
    spacing_m: float = 0.25
    spacing_deg: float = 15.0
    drift: OdometryNoise = field(default_factory=lambda: OdometryNoise(step_m=0.007, step_deg=0.35))
    judged: OdometryNoise = field(default_factory=OdometryNoise)
    cauchy: float = 3.0
    windows: tuple[int, ...] = (20, 50, 120)
    border_m: float = 0.002
    border_deg: float = 0.1
    smoothing_each: int = 40
    smoothing_most: int = 2_000
    told_m: float = 0.001
    told_deg: float = 0.05
    told_scale: float = 0.002
    doubts: int = 8
    open_links: int = 400
    measured: RelativePoseOptions = field(
        default_factory=lambda: RelativePoseOptions(min_inliers=15, min_inlier_ratio=0.3, min_matches=15)
    )
    strong: StrongLink = field(default_factory=StrongLink)
    candidates: int = 12
    apart_steps: float = 0.8
    vague_steps: float = 12.0
    same_place_m: float = 0.12
    same_place_deg: float = 8.0
    same_place_most: int = 2
    lookalike_m: float = 1.0
    lookalike_most_m: float = 5.0
    lookalike_links: int = 12
    worst_drift: float = 0.15
    optimise_every: int = 20

    def __post_init__(self) -> None:
        if self.min_links < 1 or self.min_ends < 1 or not self.windows or min(self.windows) < 2:
            raise ConfigurationError(
                "min_links and min_ends must not be below 1, nor a window below 2 keyframes",
                hint="leave them out for the defaults",
            )
