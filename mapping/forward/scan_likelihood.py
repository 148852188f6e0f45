"""How well a scan fits a map from a pose, and where it would fit better: the forward sensor model as a likelihood."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.forward.level import FARTHEST, Level, Noise
from mapping.forward.likelihood import look, tables
from mapping.forward.mapper import Fit
from mapping.grid import GridFrame
from prim.arrays import FloatArray
from prim.scan import Scan
from prim.se2 import Pose2D

NUDGE_CELLS, NUDGE_SPREAD = 0.5, 0.2
"""Derivatives are taken by differences over this many cells, or over this share of the noise where that is larger."""

LEAST_CELLS = 0.5
"""The noise counts as this many cells at least: a cell does not say where in it a surface stands."""

NUDGE_REACH = 1.0
"""A turn moves what is this far off (m) as far as the differences of place do."""

STEPS = 4
"""Gauss-Newton steps to a better pose at most."""

LONGEST = 8
"""A step is made so many times as long at most, where it goes on uphill."""

STILL_METRES, STILL_RADIANS = 2e-4, 1e-4
"""A step that is shorter is none."""

_TABLE = tables()


@dataclass(frozen=True)
class Beams:
    """A scan's measurements in the frame of its laser.

    ``rays`` (N, 5) are as :func:`mapping.forward.likelihood.look` takes them, ``limits`` range_min and range_max (m).
    """

    rays: FloatArray
    limits: tuple[float, float]

    @classmethod
    def of(cls, pieces: Sequence[tuple[Scan, Pose2D]], pose: Pose2D, most: int, offset: int = 0) -> Beams:
        """At most ``most`` measurements of a scan, evenly spread from the ``offset``-th on, as seen from ``pose``.

        ``pieces`` are parts of the scan with the pose that each was taken from. What counts as a measurement is as in
        :meth:`mapping.forward.level.Rays.add`.
        """
        first = pieces[0][0]
        back = pose.inverse()
        parts = []
        for scan, taken_from in pieces:
            seen_from = back @ Pose2D(taken_from.x, taken_from.y, taken_from.theta)
            z = scan.ranges
            with np.errstate(invalid="ignore"):
                used = ((z >= scan.range_min) & (z > 0)) | (np.isneginf(z) & (scan.range_min > 0))
            rays = np.empty((int(np.count_nonzero(used)), 5))
            rays[:, :2] = seen_from.x, seen_from.y
            rays[:, 2:4] = Pose2D(0, 0, seen_from.theta).apply(scan.directions[used])
            rays[:, 4] = np.where(z[used] >= scan.range_max, np.inf, z[used])
            parts.append(rays)
        every = np.concatenate(parts)
        stride = max(1, -(-len(every) // most))
        limits = max(first.range_min, 0.0), min(first.range_max, FARTHEST)
        return cls(np.ascontiguousarray(every[offset % stride :: stride]), limits)


@dataclass(frozen=True)
class Look:
    """A scan's log-likelihood from a pose, its slope (3,) and the information (3, 3) that it holds about the pose."""

    log_likelihood: float
    slope: FloatArray
    information: FloatArray
    rays: int


@dataclass(frozen=True)
class Likelihood:
    """A map of stopping chances that scans can be held against."""

    frame: GridFrame
    stopping: NDArray[np.float32]
    noise: Noise

    @classmethod
    def of(cls, level: Level | Fit, noise: Noise) -> Likelihood:
        """The likelihood under a level's map, or a fit's."""
        std = max(noise.std, LEAST_CELLS * level.frame.resolution)
        return cls(level.frame, level.stopping, Noise(std, noise.wild))

    def look(self, beams: Beams, pose: FloatArray, mount: FloatArray, widened: float = 1.0) -> Look:
        """A scan from a robot at ``pose`` (3,) whose laser is mounted at ``mount`` (3,); noise ``widened`` times."""
        std = self.noise.std * widened
        step = max(NUDGE_CELLS * self.frame.resolution, NUDGE_SPREAD * std)
        return self._look(beams, pose, mount, std, np.array([step, step, step / NUDGE_REACH]))

    def of_scan(self, beams: Beams, pose: FloatArray, mount: FloatArray, widened: float = 1.0) -> float:
        """The log-likelihood alone."""
        return self._look(beams, pose, mount, self.noise.std * widened, np.zeros(3)).log_likelihood

    def _look(self, beams: Beams, pose: FloatArray, mount: FloatArray, std: float, nudges: FloatArray) -> Look:
        found = np.empty(11)
        look(
            beams.rays,
            pose,
            mount,
            beams.limits,
            nudges,
            np.array(self.frame.origin),
            self.frame.resolution,
            self.stopping,
            std,
            self.noise.wild,
            _TABLE,
            found,
        )
        slope, rays = found[1:4], int(found[10])
        information = found[[4, 5, 6, 5, 7, 8, 6, 8, 9]].reshape(3, 3) - np.outer(slope, slope) / max(rays, 1)
        return Look(float(found[0]), slope, information, rays)


def climb(
    likelihood: Likelihood,
    beams: Beams,
    mount: FloatArray,
    pose: FloatArray,
    prior: FloatArray,
    believed: FloatArray,
    widened: float = 1.0,
) -> tuple[FloatArray, Look]:
    """A likelier pose (3,) by a few Gauss-Newton steps from ``pose`` on, and what the scan says there.

    ``prior`` is what is believed beforehand, with information ``believed`` (3, 3). Far off, single rays' slopes
    promise more information than there is: a step that goes on uphill is made longer, one that overshoots shorter.
    """

    def worth(at: FloatArray, log_likelihood: float) -> float:
        return float(log_likelihood - (at - prior) @ believed @ (at - prior) / 2)

    def along(step: FloatArray) -> float:
        return worth(pose + step, likelihood.of_scan(beams, pose + step, mount, widened))

    look = likelihood.look(beams, pose, mount, widened)
    for _ in range(STEPS):
        height = worth(pose, look.log_likelihood)
        slope = look.slope - believed @ (pose - prior)
        step: FloatArray = np.linalg.solve(look.information + believed, slope).astype(float)
        reached, length = along(step), 1
        while reached > height and length < LONGEST and (further := along(2 * step)) > reached:
            step, reached, length = 2 * step, further, 2 * length
        while reached <= height and not is_still(step):
            step = step / 2
            reached = along(step)
        if reached <= height or is_still(step):
            break
        pose = pose + step
        look = likelihood.look(beams, pose, mount, widened)
    return pose, look


def is_still(step: FloatArray) -> bool:
    """Whether a step (3,) is too short to count."""
    return bool(np.abs(step[:2]).max() < STILL_METRES and abs(step[2]) < STILL_RADIANS)
