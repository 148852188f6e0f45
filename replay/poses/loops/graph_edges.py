"""The edges of a pose graph: steps between keyframes by tracking, and loops."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from prim import linear_algebra
from prim.arrays import FloatArray
from prim.se2 import relative_poses
from replay.poses.loops.kernels import EdgeArrays
from replay.poses.loops.options import GraphOptions
from replay.poses.loops.submaps import Keyframes


def step_edges(keyframes: Keyframes, options: GraphOptions) -> tuple[EdgeArrays, NDArray[np.bool_]]:
    """Join each keyframe with some of those before it, by how scans matched.

    Where a wide search found the step, this is a robust edge beside a weak one, and no other edge spans it; where a
    scan fitted nowhere, there is the weak one alone.

    Args:
        keyframes: The keyframes.
        options: Covariances of steps.

    Returns:
        The edges, and which of them (E,) are robust.
    """
    numbers = np.arange(len(keyframes.poses))
    lost = np.cumsum(keyframes.broken)
    unsure = np.cumsum(keyframes.unsure & ~keyframes.broken)
    parts: list[EdgeArrays] = []
    robust: list[NDArray[np.bool_]] = []
    for lag in options.lags:
        first, last = numbers[:-lag], numbers[lag:]
        whole = lost[first] == lost[last]
        usable = whole & ((unsure[first] == unsure[last]) | (lag == 1))
        parts.append(_matched_edges(keyframes, first[usable], last[usable], options))
        robust.append((unsure[first] != unsure[last])[usable])
    found = keyframes.unsure & ~keyframes.broken
    for chosen, std in ((found, options.unsure_std), (keyframes.broken, options.broken_std)):
        last = numbers[1:][chosen[1:]]
        parts.append(_weak_edges(keyframes, last - 1, last, std, options))
        robust.append(np.zeros(len(last), bool))
    return joined_edges(parts), np.concatenate(robust)


def joined_edges(parts: list[EdgeArrays]) -> EdgeArrays:
    """Join edges.

    Args:
        parts: Some of them each.

    Returns:
        All of them.
    """
    return EdgeArrays(*(np.concatenate([part[k] for part in parts]) for k in range(len(EdgeArrays._fields))))


def edge_covariance(
    information: FloatArray, motion: FloatArray, share: float, std: tuple[float, float]
) -> FloatArray:
    """Return the covariances of matches, by what their residuals say and by what these do not show.

    Args:
        information: (..., 3, 3) of matches.
        motion: (3, 3) or (..., 3, 3) information that is known without them.
        share: The information counts by this share.
        std: Standard deviations that are added (m, rad).

    Returns:
        (..., 3, 3).
    """
    place, turn = std
    inverse = linear_algebra.inverse(share * information + motion)
    assert inverse is not None, "what is known without matches makes it positive definite"
    return inverse + np.diag([place**2, place**2, turn**2])


def turned(matrices: FloatArray, headings: FloatArray) -> FloatArray:
    """Turn covariances into the axes of poses.

    Args:
        matrices: (N, 3, 3) in the axes that the headings are given in.
        headings: (N,) rad.

    Returns:
        (N, 3, 3).
    """
    cos, sin = np.cos(headings), np.sin(headings)
    turn = np.repeat(np.eye(3)[None], len(headings), axis=0)
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1] = cos, sin, -sin, cos
    seen: FloatArray = turn @ matrices @ turn.transpose(0, 2, 1)
    return seen


def _matched_edges(
    keyframes: Keyframes, first: NDArray[np.intp], last: NDArray[np.intp], options: GraphOptions
) -> EdgeArrays:
    poses = keyframes.poses
    place, turn = options.motion_std if keyframes.odometry is None else options.odometry_std
    motion = np.diag([place**-2, place**-2, turn**-2])
    spread = edge_covariance(keyframes.information[last], motion, options.step_share, options.step_std)
    grown = options.step_factor * (1 + options.step_growth * (last - first))
    spread = turned(spread, poses[first, 2]) * grown[:, None, None]
    return EdgeArrays(first, last, relative_poses(poses[first], poses[last]), _inverses(spread))


def _weak_edges(
    keyframes: Keyframes,
    first: NDArray[np.intp],
    last: NDArray[np.intp],
    std: tuple[float, float],
    options: GraphOptions,
) -> EdgeArrays:
    poses = keyframes.poses if keyframes.odometry is None else keyframes.odometry
    motions = relative_poses(poses[first], poses[last])
    place, turn = std
    if keyframes.odometry is not None:
        place, turn = options.weak_odometry_std
    length = np.hypot(motions[:, 0], motions[:, 1]) * options.weak_odometry_share
    information = np.zeros((len(first), 3, 3))
    information[:, 0, 0] = information[:, 1, 1] = 1 / (place**2 + length**2)
    information[:, 2, 2] = turn**-2
    return EdgeArrays(first, last, motions, information)


def _inverses(matrices: FloatArray) -> FloatArray:
    inverses = linear_algebra.inverse(matrices)
    assert inverses is not None, "covariances are positive definite"
    return inverses
