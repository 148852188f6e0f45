"""Where a chunk of keyframes is searched for: in the submaps that it may lie in, by the pose graph's covariance."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray
from prim.se2 import relative_poses
from replay.poses.loops.block_cholesky import BlockCholesky
from replay.poses.loops.options import LoopOptions
from replay.poses.loops.submaps import Submaps


class LoopCandidate(NamedTuple):
    """A submap that a chunk may lie in.

    Attributes:
        chunk: The keyframe in the middle of the chunk.
        submap: That in the middle of the submap.
        guess: (3,) where the chunk's is expected in the frame of the submap's.
        reach: How far around it (m) …
        turn: … and how far to each side (rad).
    """

    chunk: int
    submap: int
    guess: FloatArray
    reach: float
    turn: float


class MotionCovariances:
    """The covariances of motions between keyframes, by a pose graph.

    Args:
        poses: (N, 3) of the keyframes.
        factor: Of the information of these.
    """

    def __init__(self, poses: FloatArray, factor: BlockCholesky) -> None:
        self._poses, self._factor, self.marginals = poses, factor, factor.marginals()

    def to(self, node: int, others: NDArray[np.intp]) -> FloatArray:
        """Return the covariances of a keyframe's pose in the frames of others.

        Args:
            node: The keyframe.
            others: (M,) the others.

        Returns:
            (M, 3, 3).
        """
        by_other, by_node = _slopes(self._poses[others], self._poses[node])
        cross = self._factor.column(node)[others]
        mixed = by_other @ cross @ by_node.transpose(0, 2, 1)
        own = by_other @ self.marginals[others] @ by_other.transpose(0, 2, 1)
        spread: FloatArray = own + by_node @ self.marginals[node] @ by_node.transpose(0, 2, 1)
        return spread + mixed + mixed.transpose(0, 2, 1)


def _slopes(frames: FloatArray, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the slopes (M, 3, 3) of a pose in some frames (M, 3), by these and by the pose."""
    cos, sin = np.cos(frames[:, 2]), np.sin(frames[:, 2])
    dx, dy = (pose[:2] - frames[:, :2]).T
    by_pose = np.zeros((len(frames), 3, 3))
    by_pose[:, 0, 0], by_pose[:, 0, 1], by_pose[:, 1, 0], by_pose[:, 1, 1] = cos, sin, -sin, cos
    by_pose[:, 2, 2] = 1.0
    by_frame = -by_pose
    by_frame[:, 0, 2], by_frame[:, 1, 2] = cos * dy - sin * dx, -cos * dx - sin * dy
    return by_frame, by_pose


def candidates(
    chunk: int, submaps: Submaps, covariances: MotionCovariances, options: LoopOptions
) -> list[LoopCandidate]:
    """Choose the submaps of earlier keyframes that a chunk may lie in, by the covariance of the motion from these.

    Submaps from which that says next to nothing, since the track was lost between, are chosen by their signatures.

    Args:
        chunk: The keyframe in the middle of the chunk.
        submaps: The submaps.
        covariances: Of the motions between keyframes.
        options: Distances and windows.

    Returns:
        The candidates, the nearest first, none beside another.
    """
    middles = np.arange(options.half_submap, chunk - options.gap, options.half_submap)
    if not len(middles):
        return []
    poses, spread = submaps.poses, covariances.to(chunk, middles)
    place = options.deviations * np.sqrt(largest_variance(spread))
    turn = options.deviations * np.sqrt(spread[:, 2, 2])
    lost = (place > options.lost_window[0]) | (turn > options.lost_window[1])
    lost &= submaps.pieces[middles] != submaps.pieces[chunk]
    reach = np.clip(place, options.least_window[0], options.most_window[0])
    turn = np.clip(turn, options.least_window[1], options.most_window[1])
    motions = relative_poses(poses[middles], np.repeat(poses[chunk : chunk + 1], len(middles), axis=0))
    away = np.hypot(motions[:, 0], motions[:, 1])
    near = np.flatnonzero((away < options.distance + reach) & ~lost)
    most = options.wide_per_chunk if (reach[near] > options.distance / 2).any() else options.per_chunk
    chosen = _apart(near[np.argsort(away[near])], most)
    found = [LoopCandidate(chunk, int(middles[k]), motions[k], float(reach[k]), float(turn[k])) for k in chosen]
    if lost.any() and chunk % options.lost_every == 0:
        found += _lost_candidates(chunk, submaps, middles[lost], options)
    return found


def _lost_candidates(
    chunk: int, submaps: Submaps, middles: NDArray[np.intp], options: LoopOptions
) -> list[LoopCandidate]:
    """Choose submaps that look most like the one around a chunk, to be searched in all headings."""
    own = submaps.signature(submaps.middle_near(chunk))
    different = np.array([np.abs(submaps.signature(int(middle)) - own).sum() for middle in middles])
    return [
        LoopCandidate(chunk, int(middles[k]), np.zeros(3), options.most_window[0], math.pi)
        for k in np.argsort(different, kind="stable")[: options.lost_per_chunk]
    ]


def _apart(numbers: NDArray[np.intp], most: int) -> list[int]:
    """Return the first of some numbers, none next to another, at most so many."""
    chosen: list[int] = []
    for k in numbers.tolist():
        if len(chosen) < most and all(abs(k - other) >= 2 for other in chosen):
            chosen.append(k)
    return chosen


def round_candidates(poses: FloatArray, options: LoopOptions) -> list[LoopCandidate]:
    """Choose all submaps near all chunks, once loops are closed.

    Args:
        poses: (N, 3) of the keyframes.
        options: Distances and windows.

    Returns:
        The candidates, by submaps.
    """
    submaps = np.arange(options.half_submap, len(poses) - 1, options.half_submap)
    found = []
    for chunk in range(0, len(poses), options.round_every):
        away = np.hypot(*(poses[submaps, :2] - poses[chunk, :2]).T)
        apart = np.abs(submaps - chunk) > options.gap
        near = np.flatnonzero((away < options.round_distance) & apart)
        chosen = _apart(near[np.argsort(away[near])], options.round_per_chunk)
        motions = relative_poses(poses[submaps[chosen]], np.repeat(poses[chunk : chunk + 1], len(chosen), axis=0))
        found += [
            LoopCandidate(chunk, int(submaps[k]), motion, *options.least_window)
            for k, motion in zip(chosen, motions, strict=True)
        ]
    return sorted(found, key=lambda one: one.submap)


def largest_variance(covariances: FloatArray) -> FloatArray:
    """Return the largest variances (N,) of the places of poses.

    Args:
        covariances: (N, 3, 3) of the poses.

    Returns:
        (N,) m².
    """
    a, b, c = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
    return np.asarray(0.5 * (a + c) + np.sqrt(0.25 * (a - c) ** 2 + b * b))
