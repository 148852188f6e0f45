"""When the beams of a scan were measured: what a log says of it, held against how well its scans fit each other.

By its definition the stamp of a sensor_msgs/LaserScan is the time of the first beam, and the others follow by
time_increment. Some drivers stamp the end of the sweep, and some turn so that beams run against time. Which of these
hypotheses holds shows where the laser's twist (its linear and angular velocity) varies: the wrong one displaces end
points by other amounts in each scan, and the map blurs.

A hypothesis is scored by the cross-validated log-likelihood of the end points, whose density is a kernel estimate (a
two-dimensional histogram that is smoothed by a Gaussian, plus a share of outliers that are uniform): short runs of
scans in turn are the data and the test, so that each hypothesis is judged by a map of its own, and no scan by itself.
The width of the kernel is the one that fits best, for each hypothesis. The maps are local, of windows of consecutive
scans, so that drift of the poses does not matter. Hypotheses are compared in pairs by the differences of blocks of
scans, which have a mean and a standard error.

Beside the hypotheses that can be chosen there are others, half a sweep off each: where one of these fits best, the
clocks of poses and scans differ, or something else is wrong, and the log's own times are kept.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray, Stamps
from prim.scan import PosedScan
from prim.se2 import relative_poses, wrap_angles
from replay.poses.laser_poses import AT_ONCE, BEAM_TIMES, BeamTimes, LaserPoses, ScanTimes, stated_beam_times


@dataclass(frozen=True)
class SweepOptions:
    """The numbers of :func:`find_beam_times`; set by hand where no source is named."""

    windows: int = 10
    """At most so many windows of scans are compared: those in which the twist varies most."""

    window_scans: int = 40
    """A window has so many consecutive scans, and fewer than twice as many."""

    run_scans: int = 5
    """So many consecutive scans belong to the same half of the cross-validation."""

    block_scans: int = 10
    """So many consecutive scans give one difference of log-likelihoods: a run of each half."""

    min_blocks: int = 8
    """Fewer blocks decide nothing."""

    beams: int = 120
    """At most about so many beams of a scan are compared, evenly spread."""

    cell_share: float = 0.2
    """Side of a histogram's cell over the standard deviation of the displacement by which hypotheses differ."""

    min_cell: float = 0.005
    """The smallest side of a cell (m)."""

    max_cells: int = 100_000
    """Cells are made larger where a histogram would have more."""

    kernel_cells: tuple[float, ...] = (1.0, 2.0, 4.0, 8.0)
    """Standard deviations of the Gaussian kernels to choose from (cells)."""

    cut_share: float = 0.01
    """The histogram leaves out this share of the end points at each of its four sides: outliers, all in all."""

    outlier_share: float = 1e-3
    """The share of outliers in the density."""

    min_t: float = 4.0
    """The mean difference to the log's own times must be so many standard errors."""

    min_t_others: float = 2.0
    """The mean differences to all other hypotheses that can be chosen must be so many."""

    others: tuple[BeamTimes, ...] = (
        BeamTimes(-0.5, 0.5),
        BeamTimes(0.5, 1.5),
        BeamTimes(-1.5, -0.5),
        BeamTimes(0.5, -0.5),
        BeamTimes(1.5, 0.5),
        BeamTimes(-0.5, -1.5),
    )
    """Hypotheses that cannot be chosen: half a sweep off those that can."""


DEFAULTS = SweepOptions()


class SweepFinding(NamedTuple):
    """Times of beams that fit better than those that the log says.

    Attributes:
        times: When the first and the last beam are measured.
        gain: The mean gain of a beam's log-likelihood (nats).
        deviations: The gain over its standard error.
    """

    times: BeamTimes
    gain: float
    deviations: float


def find_beam_times(
    scans: ScanTimes,
    poses: LaserPoses,
    reach: float,
    tolerance: float,
    read: Callable[[NDArray[np.intp]], Iterable[PosedScan]],
    poses_at: Callable[[Stamps], LaserPoses],
    options: SweepOptions = DEFAULTS,
) -> SweepFinding | None:
    """Find out whether beams were measured at other times than the log says.

    Args:
        scans: When the N scans were taken by what the log says, and how long a sweep takes.
        poses: The laser's poses at these times.
        reach: How far away surfaces are (m), by the median.
        tolerance: Displacements up to this (m) do not matter.
        read: Reads the scans at these positions (M,); their poses and pieces are not used.
        poses_at: Looks up the laser's poses at other stamps (ns).
        options: Windows, densities and the significance that is asked for.

    Returns:
        What was found; None where what the log says fits best, or the evidence is not clear.
    """
    windows, motion = _windows(scans, poses, reach, options)
    if not windows or motion < tolerance:
        return None
    stated = stated_beam_times(scans.sweep)
    hypotheses = tuple(dict.fromkeys((stated, *BEAM_TIMES.values(), AT_ONCE, *options.others)))
    chosen = np.concatenate(windows)
    posed_scans = {posed.position: posed for posed in read(chosen)}
    samples = _PoseSamples.look_up(chosen, scans.stamps[chosen], abs(scans.sweep), hypotheses, poses_at)
    fits = []
    for window in windows:
        beams = _Beams.of([posed_scans[k] for k in window.tolist() if k in samples.row and k in posed_scans], options)
        if beams.scans > options.run_scans:
            points = [beams.end_points(*samples.at(beams.positions, times)) for times in hypotheses]
            fits.append(_WindowFit(beams, _log_likelihoods(points, beams, motion, options)))
    return _decided(hypotheses, fits, options)


def _windows(
    scans: ScanTimes, poses: LaserPoses, reach: float, options: SweepOptions
) -> tuple[list[NDArray[np.intp]], float]:
    """Choose windows of consecutive scans in which the laser's motion during a sweep varies.

    Returns the positions of each window's scans, and the standard deviation of the displacement within the windows
    (m), where a turn displaces what is ``reach`` away. No window where there are too few scans or none has a motion.
    """
    order = np.argsort(scans.stamps, kind="stable")
    order = order[poses.valid[order]]
    if poses.end_poses is None or len(order) < options.min_blocks * options.block_scans:
        return [], 0.0
    motions = relative_poses(poses.poses[order], poses.end_poses[order]) * (1.0, 1.0, reach)
    parts = np.array_split(np.arange(len(order)), max(len(order) // options.window_scans, 1))
    variances = np.array([motions[part].var(axis=0).sum() for part in parts])
    largest = np.sort(np.argsort(-variances, kind="stable")[: options.windows])
    return [order[parts[k]] for k in largest.tolist()], math.sqrt(float(variances[largest].mean()))


@dataclass(frozen=True)
class _PoseSamples:
    """The laser's poses around the stamps of scans.

    Attributes:
        row: The row of each scan's position; scans without all poses are left out.
        poses: By time relative to the stamp, in sweeps: (M, 3) x, y (m), heading (rad).
    """

    row: Mapping[int, int]
    poses: Mapping[float, FloatArray]

    @classmethod
    def look_up(
        cls,
        positions: NDArray[np.intp],
        stamps: Stamps,
        duration: int,
        hypotheses: Sequence[BeamTimes],
        poses_at: Callable[[Stamps], LaserPoses],
    ) -> _PoseSamples:
        """Look up the poses at all times (in units of ``duration``, ns) that the hypotheses name."""
        times = sorted({time for hypothesis in hypotheses for time in hypothesis})
        found = poses_at(np.concatenate([stamps + round(time * duration) for time in times]))
        known = found.valid.reshape(len(times), -1).sum(axis=0) == len(times)
        row = {
            position: k
            for k, (position, is_known) in enumerate(zip(positions.tolist(), known.tolist(), strict=True))
            if is_known
        }
        return cls(row, dict(zip(times, found.poses.reshape(len(times), -1, 3), strict=True)))

    def at(self, positions: Sequence[int], times: BeamTimes) -> tuple[FloatArray, FloatArray]:
        """Return the poses (M, 3) at the first and the last beams of these scans under a hypothesis."""
        rows = [self.row[position] for position in positions]
        return self.poses[times.first][rows], self.poses[times.last][rows]


@dataclass(frozen=True)
class _Beams:
    """The measured beams of M scans.

    Attributes:
        positions: The scans' positions.
        scan: The index (N,) of each beam's scan, from 0 to M - 1.
        share: The share (N,) of the sweep from its scan's first beam to it.
        bearing: Its bearing (N,) in rad.
        range: Its range (N,) in m.
    """

    positions: list[int]
    scan: NDArray[np.intp]
    share: FloatArray
    bearing: FloatArray
    range: FloatArray

    @property
    def scans(self) -> int:
        """The number of scans."""
        return len(self.positions)

    @classmethod
    def of(cls, posed_scans: Sequence[PosedScan], options: SweepOptions) -> _Beams:
        """Collect measured beams, evenly spread over each scan."""
        columns = [np.zeros((0, 4))]
        for k, posed in enumerate(posed_scans):
            scan = posed.scan
            beams = np.arange(0, len(scan.ranges), max(1, len(scan.ranges) // options.beams))
            beams = beams[scan.measured[beams]]
            share = beams / max(len(scan.ranges) - 1, 1)
            bearing = scan.angle_min + beams * scan.angle_increment
            columns.append(np.column_stack((np.full(len(beams), k), share, bearing, scan.ranges[beams])))
        index, share, bearing, ranges = np.concatenate(columns).T
        return cls([posed.position for posed in posed_scans], index.astype(np.intp), share, bearing, ranges)

    def end_points(self, first: FloatArray, last: FloatArray) -> FloatArray:
        """Return the end points (N, 2) for poses (M, 3) at the first and the last beams (m)."""
        motion = last - first
        motion[:, 2] = wrap_angles(motion[:, 2])
        poses = first[self.scan] + self.share[:, None] * motion[self.scan]
        angle = poses[:, 2] + self.bearing
        ends: FloatArray = poses[:, :2] + self.range[:, None] * np.column_stack((np.cos(angle), np.sin(angle)))
        return ends


class _WindowFit(NamedTuple):
    """The log-likelihoods of a window's scans: (hypotheses, kernels, scans) in nats."""

    beams: _Beams
    log_likelihoods: FloatArray


def _log_likelihoods(points: Sequence[FloatArray], beams: _Beams, motion: float, options: SweepOptions) -> FloatArray:
    """Compute the cross-validated log-likelihoods of scans by the end points (N, 2) under each hypothesis.

    Returns (hypotheses, kernels, scans) in nats, of densities per cell.
    """
    every = np.concatenate(points)
    cut = (options.cut_share, 1 - options.cut_share)
    low, high = np.quantile(every, cut, axis=0) if len(every) else np.zeros((2, 2))
    area = float(np.prod(high - low))
    cell = max(options.cell_share * motion, options.min_cell, math.sqrt(area / options.max_cells))
    shape = tuple((int(extent // cell) + 1) for extent in (high - low))
    half = np.arange(beams.scans) // options.run_scans % 2
    return np.array([_kernel_fits((ends - low) / cell, shape, beams, half, options) for ends in points])


def _kernel_fits(
    cells: FloatArray, shape: tuple[int, ...], beams: _Beams, half: NDArray[np.intp], options: SweepOptions
) -> FloatArray:
    """Compute the log-likelihoods (kernels, scans) of end points (N, 2, in cells), each half by the other's."""
    index = np.floor(cells).astype(np.intp)
    within: NDArray[np.bool_] = np.logical_and.reduce((index >= 0) & (index < shape), axis=1)
    index[~within] = 0
    flat = index @ (shape[1], 1)
    uniform = options.outlier_share / (shape[0] * shape[1])
    fits = np.zeros((len(options.kernel_cells), beams.scans))
    for tested in (0, 1):
        test, data = half[beams.scan] == tested, (half[beams.scan] != tested) & within
        counts = np.bincount(flat[data], minlength=shape[0] * shape[1]).reshape(shape).astype(np.float32)
        counts *= (1 - options.outlier_share) / max(int(np.count_nonzero(data)), 1)
        for row, width in zip(fits, options.kernel_cells, strict=True):
            density = cv2.GaussianBlur(counts, (0, 0), width, borderType=cv2.BORDER_CONSTANT).ravel()
            log_density = np.log(uniform + np.where(within[test], density[flat[test]], 0.0))
            row += np.bincount(beams.scan[test], log_density, beams.scans)
    return fits


def _decided(
    hypotheses: Sequence[BeamTimes], fits: Sequence[_WindowFit], options: SweepOptions
) -> SweepFinding | None:
    """Compare the hypotheses, of which the first is what the log says; None where that is kept."""
    blocks = _block_sums(hypotheses, fits, options)
    if len(blocks) < options.min_blocks:
        return None
    best = int(np.argmax(blocks.sum(axis=0)))
    choices = [k for k, times in enumerate(hypotheses) if times not in options.others]
    deviations = {k: _standard_errors(blocks[:, best] - blocks[:, k]) for k in choices if k != best}
    if best == 0 or best not in choices or deviations[0] < options.min_t:
        return None
    if min(deviations.values()) < options.min_t_others:
        return None
    beams = sum(len(fit.beams.scan) for fit in fits)
    gain = float((blocks[:, best] - blocks[:, 0]).sum()) / max(beams, 1)
    return SweepFinding(hypotheses[best], gain, deviations[0])


def _block_sums(hypotheses: Sequence[BeamTimes], fits: Sequence[_WindowFit], options: SweepOptions) -> FloatArray:
    """Sum log-likelihoods over blocks of consecutive scans: (blocks, hypotheses), each by its best kernel."""
    if not fits:
        return np.zeros((0, len(hypotheses)))
    totals = np.sum([fit.log_likelihoods.sum(axis=2) for fit in fits], axis=0)
    kernels = totals.argmax(axis=1)
    sums = []
    for fit in fits:
        of_scans = fit.log_likelihoods[np.arange(len(hypotheses)), kernels]
        blocks = np.array_split(of_scans, max(fit.beams.scans // options.block_scans, 1), axis=1)
        sums += [block.sum(axis=1) for block in blocks]
    return np.array(sums)


def _standard_errors(differences: FloatArray) -> float:
    """Return the mean of differences (N,) over its standard error; 0 where they do not differ from 0."""
    mean, error = float(differences.mean()), float(differences.std(ddof=1)) / math.sqrt(len(differences))
    if error == 0:
        return math.copysign(math.inf, mean) if mean else 0.0
    return mean / error
