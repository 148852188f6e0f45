"""What is unsure about tracked poses whose loops are closed: the marginal covariances of a pose graph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray
from prim.se2 import frame_motions
from replay.poses.loops.pose_graph import PoseGraph
from replay.poses.tracking.track_errors import TrackErrors


@dataclass(frozen=True)
class LoopErrors(TrackErrors):
    """The covariances of N tracked poses by a pose graph of their keyframes.

    Attributes:
        nodes: (N,) the keyframe that each pose follows.
        graph: The pose graph.
    """

    nodes: NDArray[np.intp]
    graph: PoseGraph

    @classmethod
    def by_graph(
        cls, poses: FloatArray, covariances: FloatArray, keyframes: Sequence[int], graph: PoseGraph, first_std: float
    ) -> LoopErrors:
        """Sum up the errors of keyframes and of matches.

        Args:
            poses: (N, 3).
            covariances: (N, 3, 3) of each within the map that it was matched with.
            keyframes: The scans that are nodes of the graph.
            graph: The pose graph.
            first_std: Of the first pose.

        Returns:
            The errors.
        """
        nodes = np.searchsorted(np.array(keyframes), np.arange(len(poses)), side="right") - 1
        motions = frame_motions(graph.factor().marginals(), graph.poses)
        return cls(poses, frame_motions(covariances, poses), motions[nodes], first_std, nodes, graph)

    def _walked(self, first: NDArray[np.intp], last: NDArray[np.intp]) -> FloatArray:
        """Return the covariances (M, 3, 3) of the motions that keyframes do not share, by the graph's columns."""
        begin, end = self.nodes[first], self.nodes[last]
        slopes = np.broadcast_to(np.eye(3), (len(self.graph.poses), 3, 3)).copy()
        slopes[:, 0, 2], slopes[:, 1, 2] = self.graph.poses[:, 1], -self.graph.poses[:, 0]
        factor, shared = self.graph.factor(), np.empty((len(first), 3, 3))
        for node in np.unique(begin):
            rows = np.flatnonzero(begin == node)
            shared[rows] = slopes[end[rows]] @ factor.column(node)[end[rows]] @ slopes[node].T
        apart: FloatArray = self.walk[first] + self.walk[last] - shared - shared.transpose(0, 2, 1)
        return apart
