"""The numbers of tracking; all set by hand."""

from __future__ import annotations

import math
from dataclasses import dataclass, field


@dataclass(frozen=True)
class PointOptions:
    """How a scan becomes points on surfaces.

    Attributes:
        spacing: Points lie at least so far apart along the scan (m).
        reach: A line is fitted to the neighbours of a beam within this distance (m) …
        reach_noise: … or so many standard deviations of the noise, where that is more.
        most: At most so many beams on either side.
        gap: Neighbours that are further apart (m) lie on different surfaces …
        gap_beams: … or further than so many times the distance of neighbouring beams there.
        flatness: The largest ratio of the variances across and along a line.
        least_noise: Residuals count as having at least this standard deviation (m).
        coarse: Distance (m) of the points that a search uses.
        fine: Distance (m) of the points that a map is made of.
    """

    spacing: float = 0.03
    reach: float = 0.12
    reach_noise: float = 4.0
    most: int = 8
    gap: float = 0.12
    gap_beams: float = 4.0
    flatness: float = 0.1
    least_noise: float = 0.002
    coarse: float = 0.15
    fine: float = 0.06


@dataclass(frozen=True)
class LocalMapOptions:
    """The map of nearest points, the search in it, and the fit of a scan to it.

    Attributes:
        cell: Side of a cell (m).
        reach: Points further away than this (m) do not correspond.
        margin: Free border around the points (m).
        most_cells: The map is cut where it had more cells than this on a side.
        blur: A search's score falls with the distance of points from the map as a normal density of this width (m).
        levels: Levels of coarser scores that a small search has, each of twice the side.
        wide_levels: As many a wide one has.
        turn: The step of headings (rad) in a search.
        kernel: Residuals lose weight beyond this (m): Welsch's function. It is wider at first.
        widening: By how much, in the first steps.
        steps: Gauss and Newton's steps at most …
        enough: … until one is shorter than this (m, half as much in rad).
        min_cosine: Points correspond where the cosine between their normals is no less.
        point_weight: Weight of points without a line, beside those on one.
        residual: Standard deviation of residuals (m) beside which a prior counts.
    """

    cell: float = 0.05
    reach: float = 0.25
    margin: float = 0.5
    most_cells: int = 4000
    blur: float = 0.1
    levels: int = 2
    wide_levels: int = 6
    turn: float = math.radians(1.0)
    kernel: float = 0.05
    widening: tuple[float, ...] = (3.0, 3.0, 1.7, 1.7)
    steps: int = 10
    enough: float = 1e-6
    min_cosine: float = 0.3
    point_weight: float = 0.15
    residual: float = 0.03


@dataclass(frozen=True)
class TrackingOptions:
    """How scans are tracked.

    Attributes:
        points: How scans become points.
        map: How they are matched.
        keyframe_distance: A scan joins the map once the laser has moved this far (m) since the last that did …
        keyframe_turn: … or turned by this (rad).
        keyframes: The map is made of so many scans.
        odometry_std: Standard deviation of odometry's step: a constant (m), and a share of the distance.
        odometry_turn_std: That of its turn: a constant (rad), a share of the turn, and rad per m.
        velocity_std: Standard deviation of what constant velocity predicts (m, rad), from one scan to the next.
        deviations: A search reaches this many standard deviations …
        least_window: … but no less than this (m, rad).
        velocity_window: What a search by constant velocity alone reaches (m, rad).
        longest_reach: The longest that this becomes where scans are far apart in time (m).
        charge: What a search's score loses for one standard deviation from the prediction …
        wide_charge: … and, where a lost scan is searched for, for a metre or a radian.
        usual_gap: Where scans are further apart in time (s) than this, constant velocity is trusted less …
        most_stretch: … by this factor at most; nor is motion continued by more.
        least_gap: The time between two scans counts as this (s) at least.
        speed: The speed (m/s) that a search has to reach where scans are far apart in time.
        longest_step: Scans further apart in time (s) do not continue the motion.
        different: Odometry and constant velocity are both tried where they differ by more than this share of the
            window.
        lost: A scan of a lower score is searched for further away.
        min_gain: What is found there has to have a score that is better by this.
        broken: A scan of a lower score after all that stands where it was predicted, and a new map begins.
        wide_window: How far a lost scan is searched for (m, rad).
        widest: The largest window in place (m).
        settled_rounds: Rounds in which all scans are matched anew with those before and after them …
        closed_rounds: … and with those that are near once loops are closed.
        block: Keyframes that share a map in these.
        near: Where loops were closed, keyframes within this distance (m) share it as well …
        most_near: … the nearest so many.
        surfel: Points within so much (m) of each other become one in these maps.
        settled_std: Standard deviation of the prior around a scan's pose in a round (m, rad) …
        closed_std: … and where loops were closed: their graph says where scans are.
        least_std: Standard deviations of a match (m, rad) beside those that its residuals have: what a map of few
            scans has of its own; by halves of the beams of two buildings (bench/poses.py).
        first_std: Those of the first pose, which is known.
        coarse_cells: In a map with larger cells than this (m) the points of scans place these better than the map.
        closed_noise: By scans alone loops are closed in cells of any size where the range noise is below this (m).
        windows: The fit of scans is tested in so many windows …
        window_scans: … of so many scans.
        misplaced: How far poses may be off in that test (m, rad).
        worse_fit: Of two sources one is worse where its scans' score is lower by this.
        bad_fit: Poses are bad where scans score lower by this than once they are matched.
        overruled_share: Odometry that is not followed at more than this share of scans is not relied upon …
        sure_score: … where scans have a median score above this.
        least_path: Where scans move by more than this (m) …
        least_share: … and odometry by less than this share of it, it is taken to stand still.
        least_spread: Scans show the odometry's noise where they are so far (m) from those before them …
        least_windows: … and so many are …
        least_odometry_std: … but none less than this after one metre (m, rad).
    """

    points: PointOptions = field(default_factory=PointOptions)
    map: LocalMapOptions = field(default_factory=LocalMapOptions)
    keyframe_distance: float = 0.2
    keyframe_turn: float = math.radians(10)
    keyframes: int = 20
    odometry_std: tuple[float, float] = (0.02, 0.15)
    odometry_turn_std: tuple[float, float, float] = (0.01, 0.15, 0.05)
    velocity_std: tuple[float, float] = (0.12, math.radians(6))
    deviations: float = 2.5
    least_window: tuple[float, float] = (0.1, math.radians(3))
    velocity_window: tuple[float, float] = (0.35, math.radians(20))
    longest_reach: float = 1.5
    charge: float = 0.02
    wide_charge: float = 0.01
    usual_gap: float = 0.5
    most_stretch: float = 4.0
    least_gap: float = 1e-3
    speed: float = 0.7
    longest_step: float = 2.0
    different: float = 0.5
    lost: float = 0.65
    min_gain: float = 0.05
    broken: float = 0.5
    wide_window: tuple[float, float] = (1.0, math.radians(60))
    widest: float = 6.0
    settled_rounds: int = 2
    closed_rounds: int = 1
    block: int = 5
    near: float = 6.0
    most_near: int = 60
    surfel: float = 0.05
    settled_std: tuple[float, float] = (0.02, math.radians(0.3))
    closed_std: tuple[float, float] = (0.01, math.radians(0.15))
    least_std: tuple[float, float] = (0.0015, math.radians(0.06))
    first_std: float = 1e-5
    coarse_cells: float = 0.02
    closed_noise: float = 0.03
    windows: int = 6
    window_scans: int = 12
    misplaced: tuple[float, float] = (0.1, 0.05)
    worse_fit: float = 0.05
    bad_fit: float = 0.1
    overruled_share: float = 0.05
    sure_score: float = 0.8
    least_path: float = 0.5
    least_share: float = 0.1
    least_spread: float = 0.01
    least_windows: int = 12
    least_odometry_std: tuple[float, float] = (0.005, math.radians(0.3))


DEFAULTS = TrackingOptions()
