"""The numbers of loop closing."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from replay.poses.tracking.options import LocalMapOptions


@dataclass(frozen=True)
class GraphOptions:
    """The pose graph of keyframes. The covariances' numbers: by Intel's relations and by halves of the beams.

    Attributes:
        lags: Each keyframe is joined with those so many before it.
        step_share: The information of a match counts by this share: neighbouring scans share their errors …
        step_std: … and standard deviations (m, rad) are added to it …
        step_factor: … and the whole is multiplied by this, since edges overlap …
        step_growth: … and by 1 and this for each keyframe that an edge spans.
        loop_share: As ``step_share`` for loops.
        loop_std: As ``step_std`` for loops.
        motion_std: Standard deviations (m, rad) of the motion from one keyframe to the next that is known without
            scans …
        odometry_std: … and with odometry.
        unsure_std: Those of a step that a wide search found, beside which the step itself is a robust edge …
        broken_std: … and of a step to a scan that fits nowhere …
        weak_odometry_std: … and of both by odometry …
        weak_odometry_share: … to which this share of the step's length is added.
        first_std: Those of the first pose.
        scale: Squared normalised residuals at which a robust edge begins to lose its weight.
        steps: Gauss and Newton's steps at most.
        tolerance: Steps end where no pose moves by more than this (m, rad).
        damping: Levenberg and Marquardt's first damping …
        least_damping: … the least …
        most_damping: … and that at which no step helps.
        damping_factor: By how much it rises or falls.
    """

    lags: tuple[int, ...] = (1, 4, 10)
    step_share: float = 0.1
    step_std: tuple[float, float] = (0.005, math.radians(0.1))
    step_factor: float = 1.5
    step_growth: float = 0.1
    loop_share: float = 0.05
    loop_std: tuple[float, float] = (0.012, math.radians(0.25))
    motion_std: tuple[float, float] = (0.5, 0.3)
    odometry_std: tuple[float, float] = (0.1, 0.1)
    unsure_std: tuple[float, float] = (1.5, 0.7)
    broken_std: tuple[float, float] = (3.0, 1.5)
    weak_odometry_std: tuple[float, float] = (0.2, 0.1)
    weak_odometry_share: float = 0.1
    first_std: float = 1e-5
    scale: float = 12.0
    steps: int = 20
    tolerance: float = 1e-4
    damping: float = 1e-6
    least_damping: float = 1e-9
    most_damping: float = 1e3
    damping_factor: float = 10.0


@dataclass(frozen=True)
class LoopOptions:
    """How loops are found and verified; set by hand, and the same for all logs.

    Attributes:
        graph: The pose graph.
        map: The maps of keyframes.
        spacing: Points of a submap lie so far (m) apart …
        chunk_spacing: … and those of a chunk, which is searched for in it, so far.
        reach: Points further than this (m) from the laser are left out.
        half_submap: A submap has so many keyframes before and after its middle …
        half_chunk: … a chunk so many.
        most_surroundings: Where a window is wide, the chunk is searched for in its own surroundings as well: at most
            so many keyframes before and after it.
        least_points: A chunk has no fewer points than this.
        kept_submaps: So many submaps are kept in memory …
        kept_chunks: … and so many chunks.
        every: Each so many keyframes a chunk is searched for.
        gap: Keyframes that are closer than so many in time make no loop.
        distance: Chunks are searched for in submaps within this distance (m), and within the window.
        per_chunk: In so many submaps at most …
        wide_per_chunk: … or so many, where the window is wide.
        deviations: A window reaches so many standard deviations of the motion between the two keyframes …
        least_window: … and no less than this (m, rad) …
        most_window: … and no more.
        lost_window: Where so many standard deviations reach further than this (m, rad), and the track was lost
            between, the submaps are searched that look most like the one around the chunk …
        lost_every: … at each so many keyframes, a multiple of ``every`` …
        lost_per_chunk: … so many of them …
        lost_score: … and what is found must have this score at least.
        rings: They look alike where as many points lie in rings around their middle of this width (m) …
        ring_count: … so many of these.
        wide: A window that reaches further than this (m) is wide: what is found must be unique in it.
        turn: The step of headings (rad).
        levels: Levels of the search by the reach of the window (m) up to which they suffice.
        most_levels: Levels for wider windows.
        least_score: The least share of a chunk's points that lie on the submap …
        least_back: … and of those of the submap's chunk that is nearest on the submap of the other.
        start_std: Standard deviations (m, rad) of the prior around what a search finds.
        search_share: A search finds what scores this share of the least score.
        most_fitted: A fit moves no further than this (m) from what a search finds.
        second_share: A second place that scores more than this share of the best makes it ambiguous …
        apart: … where it is further than this (m, rad) from the best.
        support_keyframes: Loops support each other within so many keyframes …
        support: … so many others must agree …
        agreement: … within this (m, rad) …
        agreement_per_metre: … and this share of the way between them.
        optimise_after: The graph is optimised after so many new loops …
        optimise_share: … and this share of all before, so that the time grows in proportion to the log.
        rounds: Rounds in which all loops are searched for anew, in the poses of the last.
        round_every: Each so many keyframes in these …
        round_distance: … within this distance (m) …
        round_per_chunk: … in so many submaps at most.
        least_weight: Loops of a lower weight in the end are rejected.
    """

    graph: GraphOptions = field(default_factory=GraphOptions)
    map: LocalMapOptions = field(default_factory=LocalMapOptions)
    spacing: float = 0.06
    chunk_spacing: float = 0.1
    reach: float = 12.0
    half_submap: int = 10
    half_chunk: int = 5
    most_surroundings: int = 40
    least_points: int = 60
    kept_submaps: int = 32
    kept_chunks: int = 500
    every: int = 4
    gap: int = 30
    distance: float = 3.0
    per_chunk: int = 3
    wide_per_chunk: int = 6
    deviations: float = 4.0
    least_window: tuple[float, float] = (0.3, math.radians(4))
    most_window: tuple[float, float] = (5.0, math.radians(40))
    lost_window: tuple[float, float] = (8.0, math.radians(80))
    lost_every: int = 4
    lost_per_chunk: int = 4
    lost_score: float = 0.65
    rings: float = 0.5
    ring_count: int = 24
    wide: float = 0.6
    turn: float = math.radians(1.0)
    levels: tuple[tuple[float, int], ...] = ((0.4, 2), (1.5, 4))
    most_levels: int = 6
    least_score: float = 0.55
    least_back: float = 0.5
    start_std: tuple[float, float] = (0.1, 0.03)
    search_share: float = 0.8
    most_fitted: float = 0.4
    second_share: float = 0.9
    apart: tuple[float, float] = (0.5, math.radians(10))
    support_keyframes: int = 40
    support: int = 2
    agreement: tuple[float, float] = (0.15, math.radians(2.5))
    agreement_per_metre: float = 0.02
    optimise_after: int = 25
    optimise_share: float = 0.05
    rounds: int = 1
    round_every: int = 3
    round_distance: float = 4.0
    round_per_chunk: int = 4
    least_weight: float = 0.25


DEFAULTS = LoopOptions()
