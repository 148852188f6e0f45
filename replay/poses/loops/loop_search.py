"""Matches of chunks in submaps, and whether they can be relied upon by themselves: unique, and fitting both ways."""

from __future__ import annotations

import math
from enum import Enum
from typing import NamedTuple

import numpy as np

from prim import linear_algebra
from prim.arrays import FloatArray
from prim.se2 import compose_poses, relative_poses, wrap_angles
from replay.poses.loops.candidates import LoopCandidate
from replay.poses.loops.graph_edges import edge_covariance
from replay.poses.loops.options import LoopOptions
from replay.poses.loops.submaps import Submaps
from replay.poses.tracking.kernels import Excluded, Window
from replay.poses.tracking.local_map import LocalMap, Match


class LoopRejection(Enum):
    """Why a match is no loop."""

    AMBIGUOUS = "ambiguous"
    ONE_SIDED = "one-sided"
    UNSUPPORTED = "unsupported"
    OUTLIER = "contradicted"


class Loop(NamedTuple):
    """A keyframe that was recognised in the submap of an earlier one.

    Attributes:
        first: The keyframe in the middle of the submap.
        last: The one that was recognised.
        motion: (3,) its pose in the frame of the first: x, y (m), heading (rad).
        information: (3, 3) inverse covariance of this.
        score: The share of points that lie on the submap.
    """

    first: int
    last: int
    motion: FloatArray
    information: FloatArray
    score: float


class LoopSearch:
    """Searches for chunks in submaps.

    Args:
        submaps: The submaps and chunks.
        options: Windows and limits.
    """

    def __init__(self, submaps: Submaps, options: LoopOptions) -> None:
        self._submaps, self._options = submaps, options
        place, turn = options.start_std
        self._prior = np.diag([place**-2, place**-2, turn**-2])

    def find(self, candidate: LoopCandidate) -> Loop | LoopRejection | None:
        """Search for a chunk in a submap.

        Args:
            candidate: Which ones, and where.

        Returns:
            The loop; why what was found is none; None where nothing was.
        """
        options = self._options
        chunk, submap = self._submaps.chunk(candidate.chunk), self._submaps.submap(candidate.submap)
        if submap is None or len(chunk) < options.least_points:
            return None
        window = Window(candidate.reach, candidate.turn, options.turn, 0.0, 0.0)
        least = options.search_share * options.least_score
        found = submap.find(chunk, candidate.guess, window, self._levels(candidate.reach), least)
        if found is None:
            return None
        match = submap.match(chunk, found[0], None, self._prior)
        away = math.hypot(*(match.pose - found[0])[:2])
        lowest = options.lost_score if candidate.turn >= math.pi else options.least_score
        if match.score < lowest or away > options.most_fitted:
            return None
        if candidate.reach > options.wide and not self._is_unique(candidate, chunk, submap, match, found[1]):
            return LoopRejection.AMBIGUOUS
        if self._score_back(candidate, match) < options.least_back:
            return LoopRejection.ONE_SIDED
        return self._loop(candidate, match)

    def _is_unique(
        self, candidate: LoopCandidate, chunk: FloatArray, submap: LocalMap, match: Match, score: float
    ) -> bool:
        """Tell whether a chunk lies nowhere else in the window, nor in its own surroundings as far around."""
        options = self._options
        levels, floor = self._levels(candidate.reach), options.second_share * score
        window = Window(candidate.reach, candidate.turn, options.turn, 0.0, 0.0)
        x, y, heading = match.pose.tolist()
        here = Excluded(x, y, heading, *options.apart)
        if submap.find(chunk, candidate.guess, window, levels, floor, here) is not None:
            return False
        own = self._submaps.surroundings(candidate.chunk, candidate.reach)
        home = Excluded(0.0, 0.0, 0.0, *options.apart)
        return own is None or own.find(chunk, np.zeros(3), window, levels, floor, home) is None

    def _score_back(self, candidate: LoopCandidate, match: Match) -> float:
        """Return how well the submap's chunk that is nearest to where another was found fits that one's submap."""
        poses, half = self._submaps.poses, self._options.half_submap
        around = np.arange(max(candidate.submap - half, 0), min(candidate.submap + half + 1, len(poses)))
        frame = np.repeat(poses[candidate.submap : candidate.submap + 1], len(around), axis=0)
        seen = relative_poses(frame, poses[around])
        nearest = int(np.argmin(np.hypot(*(seen[:, :2] - match.pose[:2]).T)))
        home = self._submaps.middle_near(candidate.chunk)
        own = self._submaps.submap(home)
        if own is None:
            return 0.0
        back = relative_poses(match.pose[None], seen[nearest : nearest + 1])
        offset = relative_poses(poses[home : home + 1], poses[candidate.chunk : candidate.chunk + 1])
        return own.score(self._submaps.chunk(int(around[nearest])), compose_poses(offset, back)[0])

    def _loop(self, candidate: LoopCandidate, match: Match) -> Loop:
        graph = self._options.graph
        spread = edge_covariance(match.information, np.eye(3), graph.loop_share, graph.loop_std)
        information = linear_algebra.inverse(spread)
        assert information is not None, "covariances are positive definite"
        motion = match.pose.copy()
        motion[2] = wrap_angles(motion[2:])[0]
        return Loop(candidate.submap, candidate.chunk, motion, information, match.score)

    def _levels(self, reach: float) -> int:
        """Return how many levels of coarser scores a window needs."""
        for most, levels in self._options.levels:
            if reach <= most:
                return levels
        return self._options.most_levels
