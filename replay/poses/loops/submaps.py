"""Maps of some neighbouring keyframes, and chunks of fewer that are searched for in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray
from prim.se2 import relative_poses
from replay.poses.loops.options import LoopOptions
from replay.poses.tracking.local_map import LocalMap, joined
from replay.poses.tracking.points import moved, thinned


@dataclass(frozen=True)
class Keyframes:
    """What loops are searched in: N keyframes of a track.

    Attributes:
        points: The points (M, 4) of each, in its laser's frame.
        poses: (N, 3) x, y (m), heading (rad), the first one zero.
        information: (N, 3, 3) of each one's match, in the axes of the poses.
        odometry: (N, 3) poses by odometry; None for none.
        broken: (N,) which ones begin a new map, since the scan fitted nowhere.
        unsure: (N,) which ones were reached by a step that a wide search found.
    """

    points: Sequence[FloatArray]
    poses: FloatArray
    information: FloatArray
    odometry: FloatArray | None
    broken: NDArray[np.bool_]
    unsure: NDArray[np.bool_]

    @property
    def pieces(self) -> NDArray[np.intp]:
        """The number (N,) of the piece that each one belongs to, between scans that fitted nowhere."""
        return np.cumsum(self.broken)


class Submaps:
    """Submaps and chunks by the keyframes in their middle, in the frame of these; the last ones are kept.

    Args:
        keyframes: The keyframes.
        poses: (N, 3) of these.
        options: How many keyframes they have, and how dense points are.
    """

    def __init__(self, keyframes: Keyframes, poses: FloatArray, options: LoopOptions) -> None:
        self.poses, self.pieces = poses, keyframes.pieces
        self._options = options
        self._points = [self._within_reach(points) for points in keyframes.points]
        self._kept: dict[tuple[int, int], LocalMap] = {}
        self._chunks: dict[int, FloatArray] = {}
        self._signatures: dict[int, FloatArray] = {}

    def chunk(self, middle: int) -> FloatArray:
        """Return the points (M, 4) of a keyframe and its neighbours."""
        options = self._options
        if middle not in self._chunks:
            around = self._joined(middle, self._around(middle, options.half_chunk))
            self._chunks[middle] = thinned(around, options.chunk_spacing)
            if len(self._chunks) > options.kept_chunks:
                self._chunks.pop(next(iter(self._chunks)))
        return self._chunks[middle]

    def submap(self, middle: int) -> LocalMap | None:
        """Return the map of a keyframe and its neighbours; None where they have no points."""
        return self._map(middle, self._options.half_submap)

    def middle_near(self, number: int) -> int:
        """Return the keyframe of its piece that has a submap in common with others, and is nearest in time."""
        spacing = self._options.half_submap
        middle = min(round(number / spacing) * spacing, len(self._points) - 1)
        return middle if self.pieces[middle] == self.pieces[number] else number

    def surroundings(self, middle: int, reach: float) -> LocalMap | None:
        """Return the map of a keyframe and of those before and after it whose scans reach as far as a window.

        Args:
            middle: The keyframe.
            reach: Of the window (m).

        Returns:
            The map; None where there are no points.
        """
        near = np.hypot(*(self.poses[:, :2] - self.poses[middle, :2]).T) < reach
        half = self._options.half_submap
        away = np.flatnonzero(~near)
        before, after = away[away < middle], away[away > middle]
        first = int(before[-1]) + 1 if len(before) else 0
        last = int(after[0]) - 1 if len(after) else len(near) - 1
        return self._map(middle, min(max(half, middle - first, last - middle), self._options.most_surroundings))

    def signature(self, middle: int) -> FloatArray:
        """Return the shares (R,) of a submap's points that lie in rings around its middle, whatever its heading."""
        options = self._options
        if middle not in self._signatures:
            points = thinned(self._joined(middle, self._around(middle, options.half_submap)), options.chunk_spacing)
            rings = (np.hypot(points[:, 0], points[:, 1]) / options.rings).astype(int)
            counts = np.bincount(rings[rings < options.ring_count], minlength=options.ring_count)
            self._signatures[middle] = counts / max(counts.sum(), 1)
        return self._signatures[middle]

    def _map(self, middle: int, half: int) -> LocalMap | None:
        key = middle, half
        if key in self._kept:
            self._kept[key] = self._kept.pop(key)  # the last one used is the last to go
            return self._kept[key]
        points = self._joined(middle, self._around(middle, half))
        if not len(points):
            return None
        self._kept[key] = LocalMap(points, self._options.map)
        if len(self._kept) > self._options.kept_submaps:
            self._kept.pop(next(iter(self._kept)))
        return self._kept[key]

    def _around(self, middle: int, half: int) -> NDArray[np.intp]:
        numbers = np.arange(max(0, middle - half), min(len(self._points), middle + half + 1))
        return np.asarray(numbers[self.pieces[numbers] == self.pieces[middle]])

    def _joined(self, middle: int, numbers: NDArray[np.intp]) -> FloatArray:
        frames = np.repeat(self.poses[middle : middle + 1], len(numbers), axis=0)
        places = relative_poses(frames, self.poses[numbers])
        return joined([moved(self._points[k], place) for k, place in zip(numbers.tolist(), places, strict=True)])

    def _within_reach(self, points: FloatArray) -> FloatArray:
        near = np.hypot(points[:, 0], points[:, 1]) < self._options.reach
        return thinned(np.ascontiguousarray(points[near]), self._options.spacing)
