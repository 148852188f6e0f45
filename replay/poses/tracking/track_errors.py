"""What is unsure about tracked poses: an error of each scan's own, and a random walk of those of keyframes.

An error of a pose moves all that is seen from it. Errors are therefore summed as motions of the frame, given at its
origin: then that of a pose in the frame of another is what both do not have in common.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray
from prim.se2 import frame_covariances, frame_motions


@dataclass(frozen=True)
class TrackErrors:
    """The covariances of N tracked poses.

    Attributes:
        poses: (N, 3) x, y (m), heading (rad).
        own: (N, 3, 3) of each scan's own error, as a motion of the frame.
        walk: (N, 3, 3) of what keyframes up to each scan have added, as that.
        first_std: Standard deviation (m, rad) of the first pose, which is known.
    """

    poses: FloatArray
    own: FloatArray
    walk: FloatArray
    first_std: float

    @classmethod
    def of(
        cls,
        poses: FloatArray,
        covariances: FloatArray,
        keyframes: Sequence[int],
        breaks: Sequence[int],
        break_std: float,
        first_std: float,
    ) -> TrackErrors:
        """Sum up the errors of matches.

        Args:
            poses: (N, 3).
            covariances: (N, 3, 3) of each within the map that it was matched with.
            keyframes: The scans that maps are made of: their errors stay in all that follows.
            breaks: The scans that fitted nowhere.
            break_std: How far what follows these may be off (m, rad).
            first_std: Of the first pose.

        Returns:
            The errors.
        """
        own = frame_motions(covariances, poses)
        steps = np.zeros_like(own)
        later = np.array(keyframes[1:], dtype=np.intp)
        steps[later] = own[later]
        lost = np.array(breaks, dtype=np.intp)
        anywhere = np.repeat(break_std**2 * np.eye(3)[None], len(lost), axis=0)
        steps[lost] += frame_motions(anywhere, poses[lost])
        return cls(poses, own, np.cumsum(steps, axis=0), first_std)

    def since_first(self) -> FloatArray:
        """Return the covariances (N, 3, 3) of the poses in the frame of the first one."""
        everything = self.walk + self.own + self.own[0]
        everything[0] = 0.0
        return frame_covariances(everything, self.poses) + self.first_std**2 * np.eye(3)

    def between(self, first: NDArray[np.intp], last: NDArray[np.intp]) -> FloatArray:
        """Return the covariances of the motions from some poses to later ones.

        Args:
            first: (M,) indices of poses.
            last: (M,) those of the later ones.

        Returns:
            (M, 3, 3) of each later pose in the frame of the earlier one.
        """
        apart = self._walked(first, last) + self.own[first] + self.own[last]
        spread = frame_covariances(apart, self.poses[last])
        cos, sin = np.cos(self.poses[first, 2]), np.sin(self.poses[first, 2])
        turn = np.repeat(np.eye(3)[None], len(first), axis=0)
        turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1] = cos, sin, -sin, cos
        seen: FloatArray = turn @ spread @ turn.transpose(0, 2, 1)
        return seen

    def _walked(self, first: NDArray[np.intp], last: NDArray[np.intp]) -> FloatArray:
        """Return the covariances (M, 3, 3) of what keyframes have added between some poses and later ones."""
        return self.walk[last] - self.walk[first]
