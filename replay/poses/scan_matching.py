"""Poses corrected by the map: each scan is matched to a forward map of the scans, and all poses are smoothed anew.

Poses that drift are first corrected scan by scan, as the map grows: a few Gauss-Newton steps each, from where the
odometry says. Then in rounds: a map of all scans, what each of them says about its pose in it, and a smoother over
all poses, odometry, fixes and headings. What a scan says is its rays' likelihood under the forward sensor model.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from mapping.forward.mapper import ForwardMapper
from mapping.forward.scan_likelihood import Beams, Likelihood, climb
from prim.arrays import FloatArray, Stamps
from prim.scan import PosedScan, Scan
from prim.se2 import Pose2D, Trajectory, wrap_angles
from prim.world import Bounds
from replay.poses.fusion import Fusion, PoseNoise, matrices_of, nodes_at, six_of, steps_between
from replay.poses.kalman import LEAST_VARIANCE
from replay.poses.localize import LaserPoses, carried, compose

RAYS = 180
"""So many rays of a scan are matched at most."""

CELLS = 1_000_000
"""The growing map has cells of twice the resolution, or larger ones where it would have more."""

ROUNDS = 12
"""So many maps are made of all scans at most."""

TRUST = np.diag([0.1**-2, 0.1**-2, math.radians(2) ** -2])
"""How far a scan may lead its pose in a round: what is believed of it, in place of what other sensors say."""

MOST_WIDENED, SURE = 8.0, 2.5
"""The noise is widened so that the pose is within it at first: SURE standard deviations of the pose, and no more."""

FIRST_ROUND = 4
"""All scans so far are matched anew when they are so many, and each time that they have doubled."""

LEAST_GAIN = 3e-3
"""The rounds end when one raises the mean log-likelihood of a ray by less."""

ADAPTS = 0.3
"""How quickly the odometry is taken to be worse than was thought, where the scans say so."""

UNTOLD = 10.0
"""Steps between poses that do not drift are off by so many times what the poses are: they tell next to nothing."""

MOST_WORSE = 1e4

LEAST_RAYS = 10
"""Scans with fewer rays on the map are not matched."""

Posed = Callable[[LaserPoses], Iterator[PosedScan]]


def match(
    poses: LaserPoses,
    stamps: Stamps,
    posed: Posed,
    resolution: float,
    noise_std: float | None = None,
    noise: PoseNoise | None = None,
    bounds: Bounds | None = None,
) -> LaserPoses:
    """The laser's poses corrected by a map with cells of ``resolution`` (m), made of the scans themselves.

    It grows with the scans unless ``bounds`` are given.

    ``posed`` gives the scans with the poses that it is given, ``stamps`` (N,) are all scans'. ``noise_std`` (m) is
    the range noise where it is known. Poses that were not fused are taken for odometry of such ``noise``; or, where
    that tells of fixes and headings, for poses that do not drift and are off by so much each.
    """
    return Matcher(poses, stamps, posed, resolution, noise_std, noise, bounds).run()


class Matcher:
    """The work of :func:`match`: poses of the robot at the nodes of a fusion, corrected by scans."""

    def __init__(
        self,
        poses: LaserPoses,
        stamps: Stamps,
        posed: Posed,
        resolution: float,
        noise_std: float | None,
        noise: PoseNoise | None,
        bounds: Bounds | None,
    ) -> None:
        self._poses, self._posed = poses, posed
        self._resolution, self._noise_std, self._bounds = resolution, noise_std, bounds
        known = noise or PoseNoise()
        if poses.fusion is not None:
            self._fusion = poses.fusion
        elif known.fixes is not None and known.headings is not None:
            self._fusion = _steady(poses, stamps, known.fixes, known.headings)
        else:
            self._fusion = _drifting(poses, stamps, known)
        self._drifts = not self._fusion.nodes.has_fixes.any()
        self._mounts = np.zeros_like(poses.poses) if poses.mounts is None or not poses.fusion else poses.mounts
        nodes = self._fusion.nodes.stamps
        self._node = np.searchsorted(nodes, np.clip(stamps, nodes[0], nodes[-1]))
        estimate = self._fusion.smoothed()
        self._robot, self._spread = estimate.poses, six_of(estimate.covariances)
        self._beams: dict[int, Beams] = {}
        self._scans: list[PosedScan] = []
        self._worse = 1.0

    def run(self) -> LaserPoses:
        """The corrected poses."""
        if self._drifts:
            self._as_the_map_grows()
            self._in_rounds(ROUNDS)
        else:
            for posed in self._posed(self._poses):
                self._keep(posed)
            self._in_rounds(ROUNDS, SURE * math.sqrt(float(self._spread[:, [0, 3, 5]].sum(axis=1).mean())))
        return self._corrected()

    def _as_the_map_grows(self) -> None:
        """Each scan matched to the map of those before it; all of them anew whenever they are twice as many."""
        mapper = ForwardMapper(self._resolution, self._bounds, self._noise_std, stream_cells=CELLS)
        state, spread = self._fusion.start
        at, due = -1, FIRST_ROUND
        for posed in sorted(self._posed(self._poses), key=lambda posed: int(self._node[posed.position])):
            node, mount = int(self._node[posed.position]), self._mounts[posed.position]
            if node > at:
                state, spread = self._fusion.advance(at + 1, node + 1, state, spread, self._worse)
                at = node
            beams = self._keep(posed)
            so_far = mapper.so_far()
            if so_far is not None:
                state, spread = self._settled(Likelihood.of(*so_far), beams, mount, state, spread)
            self._robot[node] = state
            for scan, pose in moved(posed, self._laser(posed.position)):
                mapper.update(scan, pose)
            if len(self._scans) == due:
                self._in_rounds(1, nodes=at + 1)
                mapper = self._kept()
                mapper.settle()
                state, spread = self._robot[at].copy(), self._spread[at].copy()
                due *= 2

    def _keep(self, posed: PosedScan) -> Beams:
        """Remembers a scan, and some of its beams to be matched."""
        beams = Beams.of(posed.pieces, posed.pose, RAYS, posed.position)
        self._beams[posed.position] = beams
        self._scans.append(posed)
        return beams

    def _in_rounds(self, most: int, off: float = 0.0, nodes: int | None = None) -> None:
        """Maps of the scans so far and poses by these maps, in turns, until the scans fit no better.

        Poses may be ``off`` (m) at first: the noise is widened to that, so that scans find their places. ``nodes`` is
        how many of the nodes the scans so far belong to; None: all.
        """
        reached, widened = -math.inf, 0.0
        before = self._robot, self._spread
        for _ in range(most):
            likelihood = self._map()
            widened = widened or widening(off, likelihood)
            fits, rows = self._looks(likelihood, widened)
            if widened == 1.0 and fits < reached:
                self._robot, self._spread = before
            if widened == 1.0 and fits - reached < LEAST_GAIN:
                break
            reached = fits if widened == 1.0 else reached
            widened = max(widened / 2, 1.0)
            before = self._robot.copy(), self._spread.copy()
            self._smooth(rows, nodes)

    def _smooth(self, rows: FloatArray, nodes: int | None) -> None:
        estimate = self._fusion.smoothed(rows, self._worse, nodes)
        self._robot[:nodes] = estimate.poses
        self._spread[:nodes] = six_of(estimate.covariances)
        self._worse = max(self._worse, self._misled(nodes))

    def _misled(self, nodes: int | None) -> float:
        """How many times the odometry's variances the corrections of its steps are."""
        part = self._fusion.nodes.part(0, nodes)
        if len(part.steps) < 2:
            return 1.0
        off = steps_between(self._robot[:nodes])[1:] - part.steps[1:]
        off[:, 2] = wrap_angles(off[:, 2])
        variances = part.ways[1:, None] * self._fusion.odometry_std**2 + LEAST_VARIANCE
        return min(float((off**2 / variances).mean()), MOST_WORSE)

    def _map(self) -> Likelihood:
        """The map of the scans so far from where they are believed to have been taken."""
        fit = self._kept().fit()
        return Likelihood.of(fit, fit.noise)

    def _kept(self) -> ForwardMapper:
        """A mapper that was given the scans so far from where they are believed to have been taken."""
        mapper = ForwardMapper(self._resolution, self._bounds, self._noise_std, stream_cells=CELLS)
        for posed in self._scans:
            for scan, pose in moved(posed, self._laser(posed.position)):
                mapper.keep(scan, pose)
        return mapper

    def _laser(self, position: int) -> Pose2D:
        """The laser's pose at a scan, as believed."""
        return Pose2D(*self._robot[self._node[position]].tolist()) @ Pose2D(*self._mounts[position].tolist())

    def _settled(
        self, likelihood: Likelihood, beams: Beams, mount: FloatArray, prior: FloatArray, spread: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """The likeliest pose by what was believed before (a pose, a covariance (6,)) and a scan; its covariance."""
        believed = inverse_of(matrices_of(spread))
        pose = prior.copy()
        widened = widening(SURE * math.sqrt(spread[0] + spread[3] + spread[5]), likelihood)
        while True:
            pose, look = climb(likelihood, beams, mount, pose, prior, believed, widened)
            if widened <= 1:
                break
            widened = max(widened / 2, 1.0)
        if look.rays < LEAST_RAYS:
            return prior, spread
        after = inverse_of(believed + look.information)
        off = pose - prior
        surprise = float(off @ believed @ off + np.trace(believed @ after)) / 3
        self._worse = min(max(self._worse * surprise**ADAPTS, 1.0), MOST_WORSE)
        return pose, six_of(after)

    def _looks(self, likelihood: Likelihood, widened: float) -> tuple[float, FloatArray]:
        """Mean log-likelihood of a ray, and what each node's scans say about its pose (N, 12)."""
        rows = np.zeros((len(self._robot), 12))
        total, rays = 0.0, 0
        for posed in self._scans:
            node, mount = self._node[posed.position], self._mounts[posed.position]
            beams, pose = self._beams[posed.position], self._robot[node]
            total += likelihood.of_scan(beams, pose, mount, widened)
            rays += len(beams.rays)
            best, look = climb(likelihood, beams, mount, pose, pose, TRUST, widened)
            if look.rays >= LEAST_RAYS:
                row = rows[node]
                row[:3] += look.slope - matrices_of(row[3:9]) @ (
                    best - row[9:]
                )  # another scan of this node looked elsewhere
                row[3:9] += six_of(look.information)
                row[9:] = best
        return total / max(rays, 1), rows

    def _corrected(self) -> LaserPoses:
        """The laser's poses; as unsure as the smoother says, and as the map's own place is."""
        robot = self._robot[self._node]
        poses = compose(robot, self._mounts)
        covariances = carried(matrices_of(self._spread[self._node]), robot, self._mounts)
        covariances[:, [0, 1], [0, 1]] += (
            self._resolution**2 / 12
        )  # a map does not say where in its cells walls stand
        if self._poses.frame_covariance is not None:
            covariances = covariances + moved_frame(self._poses.frame_covariance, poses)
        ends = self._ends(poses)
        return replace(self._poses, poses=poses, ends=ends, covariances=covariances, matched=True)

    def _ends(self, poses: FloatArray) -> FloatArray | None:
        """The poses at the last beams, as far from those at the first as they were."""
        if self._poses.ends is None:
            return None
        return compose(poses, between(self._poses.poses, self._poses.ends))


def moved(posed: PosedScan, pose: Pose2D) -> Iterator[tuple[Scan, Pose2D]]:
    """The pieces of a scan whose first beam was taken from ``pose`` instead."""
    back = Pose2D(posed.pose.x, posed.pose.y, posed.pose.theta).inverse()
    for scan, at in posed.pieces:
        yield scan, pose @ (back @ Pose2D(at.x, at.y, at.theta))


def widening(off: float, likelihood: Likelihood) -> float:
    """How many times the noise is taken where a pose may be ``off`` (m), so that a scan finds its place."""
    return min(max(off / likelihood.noise.std, 1.0), MOST_WIDENED)


def _drifting(poses: LaserPoses, stamps: Stamps, noise: PoseNoise) -> Fusion:
    """Poses that were not fused taken for odometry: the laser's own, from the first one on."""
    trajectory = Trajectory.from_unsorted(stamps[poses.valid], poses.poses[poses.valid])
    return Fusion(nodes_at(trajectory.stamps, trajectory, None, None), noise)


def _steady(poses: LaserPoses, stamps: Stamps, metres: float, radians: float) -> Fusion:
    """Poses that do not drift but are each off by so much; of the way between two of them nothing else is known."""
    trajectory = Trajectory.from_unsorted(stamps[poses.valid], poses.poses[poses.valid])
    fixes, turns = (trajectory.stamps, trajectory.poses[:, :2]), (trajectory.stamps, trajectory.poses[:, 2])
    nodes = replace(nodes_at(trajectory.stamps, trajectory, fixes, turns), ways=np.ones(len(trajectory)))
    noise = PoseNoise(metres, radians, UNTOLD * metres, UNTOLD * radians, 0.0)
    return Fusion(nodes, noise)


def between(poses: FloatArray, others: FloatArray) -> FloatArray:
    """Poses (N, 3) as seen from others (N, 3): ``others`` in the frames of ``poses``."""
    change = others - poses
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x, y = cos * change[:, 0] + sin * change[:, 1], cos * change[:, 1] - sin * change[:, 0]
    return np.column_stack((x, y, wrap_angles(change[:, 2])))


def moved_frame(covariance: FloatArray, poses: FloatArray) -> FloatArray:
    """What poses (N, 3) are unsure by (N, 3, 3) where their map's frame is unsure by ``covariance`` at its origin."""
    turn = np.broadcast_to(np.eye(3), (len(poses), 3, 3)).copy()
    turn[:, 0, 2], turn[:, 1, 2] = -poses[:, 1], poses[:, 0]
    moved_by: FloatArray = turn @ covariance @ turn.transpose(0, 2, 1)
    return moved_by


def inverse_of(matrix: FloatArray) -> FloatArray:
    """The inverse in double precision."""
    inverse: FloatArray = np.linalg.inv(matrix).astype(float)
    return inverse
