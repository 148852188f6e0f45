"""Loops of a track: found in the order of time, then anew in rounds, with the pose graph that they close."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray
from prim.se2 import compose_poses, relative_poses
from replay.poses.loops.candidates import LoopCandidate, MotionCovariances, candidates, round_candidates
from replay.poses.loops.consistency import connected, count_stretches, supported
from replay.poses.loops.graph_edges import joined_edges, step_edges
from replay.poses.loops.kernels import EdgeArrays
from replay.poses.loops.loop_search import Loop, LoopRejection, LoopSearch
from replay.poses.loops.options import DEFAULTS, LoopOptions
from replay.poses.loops.pose_graph import GEMAN_MCCLURE, HUBER, PoseGraph, RobustLoss
from replay.poses.loops.submaps import Keyframes, Submaps


@dataclass(frozen=True)
class ClosedLoops:
    """The loops of a track, and the poses that fit them.

    Attributes:
        poses: (N, 3) of the keyframes.
        loops: The recognised keyframes that are relied upon.
        closed: How many loops they close: stretches of neighbouring keyframes that recognise each other.
        rejected: How many recognised keyframes were rejected, by the reason.
        connected: (N,) equal numbers for keyframes that the track or loops connect.
        graph: The pose graph; its poses are these.
    """

    poses: FloatArray
    loops: tuple[Loop, ...]
    closed: int
    rejected: dict[LoopRejection, int]
    connected: NDArray[np.intp]
    graph: PoseGraph


class LoopCloser:
    """Finds and closes the loops of a track.

    Args:
        keyframes: The track's keyframes.
        options: Windows, limits, the pose graph.
    """

    def __init__(self, keyframes: Keyframes, options: LoopOptions = DEFAULTS) -> None:
        self._keyframes, self._options = keyframes, options
        self._pieces = keyframes.pieces
        self._steps = step_edges(keyframes, options.graph)
        self._poses = keyframes.poses.copy()
        self._loops: list[Loop] = []
        self._rejected: Counter[LoopRejection] = Counter()

    def run(self) -> ClosedLoops:
        """Find and close loops.

        Returns:
            What was found; the poses are those of the track where there are none.
        """
        self._sweep()
        rejected = self._rejected.copy()  # a round finds the same ones again
        if self._loops:
            for _ in range(self._options.rounds):
                self._search_anew()
        graph = self._optimise(GEMAN_MCCLURE) if self._loops else self._graph()
        weights = graph.weights[len(self._steps[1]) :]
        kept = [loop for loop, w in zip(self._loops, weights, strict=True) if w >= self._options.least_weight]
        rejected[LoopRejection.OUTLIER] += len(self._loops) - len(kept)
        count = count_stretches(kept, self._options.support_keyframes)
        return ClosedLoops(self._poses, tuple(kept), count, dict(+rejected), connected(kept, self._pieces), graph)

    def _sweep(self) -> None:
        """Search in the order of time; loops that others agree with are closed on the way."""
        options = self._options
        submaps = Submaps(self._keyframes, self._poses, options)
        search = LoopSearch(submaps, options)
        covariances = MotionCovariances(self._poses, self._graph().factor())
        pending: list[Loop] = []
        new = 0
        for chunk in range(options.every * math.ceil(options.gap / options.every), len(self._poses), options.every):
            pending += self._searched(search, candidates(chunk, submaps, covariances, options))
            sure = supported(pending, self._poses, self._pieces, options)
            added = [loop for loop, is_sure in zip(pending, sure, strict=True) if is_sure]
            pending = [loop for loop, is_sure in zip(pending, sure, strict=True) if not is_sure]
            recent = [loop for loop in pending if chunk - loop.last <= options.support_keyframes]
            self._rejected[LoopRejection.UNSUPPORTED] += len(pending) - len(recent)
            pending, new, joins = recent, new + len(added), self._join_pieces(added)
            self._loops += added
            if joins or new >= max(options.optimise_after, options.optimise_share * len(self._loops)):
                covariances, new = self._closed(), 0
        self._rejected[LoopRejection.UNSUPPORTED] += len(pending)
        if new:
            self._closed()

    def _join_pieces(self, added: list[Loop]) -> bool:
        """Move pieces of the track that loops join first to where these put them; tell whether there are any."""
        joins = False
        if not self._pieces[-1]:
            return False
        for k, loop in enumerate(added):
            joint = connected([*self._loops, *added[:k]], self._pieces)
            if joint[loop.first] == joint[loop.last]:
                continue
            later = np.flatnonzero(self._pieces >= self._pieces[loop.last])
            to = compose_poses(self._poses[loop.first : loop.first + 1], loop.motion[None])
            last = np.repeat(self._poses[loop.last : loop.last + 1], len(later), axis=0)
            seen = relative_poses(last, self._poses[later])
            self._poses[later] = compose_poses(np.repeat(to, len(later), axis=0), seen)
            joins = True
        return joins

    def _closed(self) -> MotionCovariances:
        graph = self._optimise(HUBER)
        return MotionCovariances(self._poses, graph.factor())

    def _searched(self, search: LoopSearch, wanted: list[LoopCandidate]) -> list[Loop]:
        found = []
        for candidate in wanted:
            loop = search.find(candidate)
            if isinstance(loop, LoopRejection):
                self._rejected[loop] += 1
            elif loop is not None:
                found.append(loop)
        return found

    def _search_anew(self) -> None:
        """Search for all loops in the poses as they are."""
        search = LoopSearch(Submaps(self._keyframes, self._poses, self._options), self._options)
        self._loops = self._searched(search, round_candidates(self._poses, self._options))
        self._optimise(GEMAN_MCCLURE)

    def _graph(self) -> PoseGraph:
        edges, robust = self._steps
        if self._loops:
            edges = joined_edges([edges, _edges(self._loops)])
            robust = np.concatenate((robust, np.ones(len(self._loops), bool)))
        return PoseGraph(self._poses, edges, robust, self._options.graph)

    def _optimise(self, loss: RobustLoss) -> PoseGraph:
        graph = self._graph()
        graph.optimise(loss)
        self._poses[:] = graph.poses
        return graph


def _edges(loops: list[Loop]) -> EdgeArrays:
    def nodes(name: str) -> NDArray[np.intp]:
        return np.array([getattr(loop, name) for loop in loops], np.intp)

    return EdgeArrays(
        nodes("first"),
        nodes("last"),
        np.array([loop.motion for loop in loops]),
        np.array([loop.information for loop in loops]),
    )
