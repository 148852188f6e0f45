"""Whether loops agree with those of neighbouring keyframes, since one alone is not relied upon; what they connect."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray
from prim.se2 import compose_poses, relative_poses, wrap_angles
from replay.poses.loops.loop_search import Loop
from replay.poses.loops.options import LoopOptions


def agreeing(
    loops: Sequence[Loop], poses: FloatArray, pieces: NDArray[np.intp], options: LoopOptions
) -> NDArray[np.bool_]:
    """Tell which loops put two keyframes where the track between them does, by each pair of loops.

    Args:
        loops: L loops.
        poses: (N, 3) of the keyframes.
        pieces: (N,) the piece of the track that each belongs to.
        options: What agrees.

    Returns:
        (L, L); a loop does not agree with another one of the same keyframe.
    """
    first, last = np.array([loop.first for loop in loops]), np.array([loop.last for loop in loops])
    placed = compose_poses(poses[first], np.array([loop.motion for loop in loops]))
    way = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))))
    count = len(loops)
    a, b = (grid.ravel() for grid in np.meshgrid(np.arange(count), np.arange(count), indexing="ij"))
    carried = compose_poses(placed[b], relative_poses(poses[last[b]], poses[last[a]]))
    apart = relative_poses(placed[a], carried)
    place, turn = options.agreement
    limit = place + options.agreement_per_metre * np.abs(way[last[a]] - way[last[b]])
    agrees = (np.hypot(apart[:, 0], apart[:, 1]) < limit) & (np.abs(wrap_angles(apart[:, 2])) < turn)
    agrees &= (pieces[last[a]] == pieces[last[b]]) & (last[a] != last[b])
    agrees &= np.abs(last[a] - last[b]) <= options.support_keyframes
    return np.asarray(agrees.reshape(count, count))


def supported(
    loops: Sequence[Loop], poses: FloatArray, pieces: NDArray[np.intp], options: LoopOptions
) -> NDArray[np.bool_]:
    """Tell which loops enough others agree with.

    Args:
        loops: L loops.
        poses: (N, 3) of the keyframes.
        pieces: (N,) the piece of the track that each belongs to.
        options: What agrees, and how many are enough.

    Returns:
        (L,).
    """
    if not loops:
        return np.zeros(0, bool)
    agrees = agreeing(loops, poses, pieces, options)
    last = np.array([loop.last for loop in loops])
    return np.array([len(np.unique(last[row])) >= options.support for row in agrees])


def count_stretches(loops: Sequence[Loop], most_apart: int) -> int:
    """Count loops as people do: those of neighbouring keyframes are one, and those between neighbours none.

    Args:
        loops: The loops between single keyframes.
        most_apart: Keyframes that are no further apart are neighbours.

    Returns:
        How many there are.
    """
    ends = np.sort(np.array([(loop.first, loop.last) for loop in loops]).reshape(-1, 2), axis=1)
    ends = ends[ends[:, 1] - ends[:, 0] > most_apart]
    groups = np.arange(len(ends))
    for k, end in enumerate(ends):
        near = np.unique(groups[: k + 1][np.abs(ends[: k + 1] - end).max(axis=1) <= most_apart])
        groups[np.isin(groups, near)] = near[0]
    return len(np.unique(groups))


def connected(loops: Sequence[Loop], pieces: NDArray[np.intp]) -> NDArray[np.intp]:
    """Find what loops connect.

    Args:
        loops: The loops.
        pieces: (N,) the piece of the track that each keyframe belongs to.

    Returns:
        (N,) the lowest number of the pieces that each keyframe's is connected with.
    """
    numbers = np.arange(pieces[-1] + 1)
    ends = np.array([(loop.first, loop.last) for loop in loops], np.intp).reshape(-1, 2)
    for pair in np.unique(pieces[ends], axis=0):
        a, b = np.sort(numbers[pair])
        numbers[numbers == b] = a
    return np.asarray(numbers[pieces])
