"""The numbers of refinement, each in one place, with its unit and where it comes from.

Where no source is named a number was set by hand, and is tested only by what ``python -m bench.refine`` measures of
the whole (docs/refine.md).

Lengths that go with the size of what is fitted are marked by :func:`scaled`: they hold for things of up to 0.7 m in a
map with cells of 1 cm, and :meth:`RefinementOptions.at_scale` multiplies them for larger things in larger cells.
Lengths that go with the sensor stay.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

from prim.choices import DEFAULT_SIZES

SCALED = "scaled"
"""Key of the fields' metadata that marks the lengths which go with the size of what is fitted."""


def scaled(metres: float) -> Any:
    """Make a field for a length (m) that goes with the size of what is fitted."""
    return field(default=metres, metadata={SCALED: True})


@dataclass(frozen=True)
class RayOptions:
    """Which rays a candidate is fitted to."""

    max_rays: int = 8000
    """Rays of one candidate; of more than twice as many every other scan is left out. Bounds the time."""
    max_total: int = 200_000
    """Rays of all candidates together, about, as long as each has …"""
    min_rays: int = 2000
    """… so many."""
    max_range: float = 1000.0
    """m; a sensor whose range_max is larger, or infinite, is taken to reach so far."""
    room_share: float = 0.05
    """What more of its scans than this share begin in is a room; a guess that is too large, or a scanner that brushes
    past, has few of them."""
    reach: float = scaled(0.07)
    """m; rays that pass a candidate at this distance are collected."""
    fitted_reach: float = scaled(0.03)
    """m; the same once it is fitted."""
    similar_nats: float = 0.5
    """nats; a ray's background has changed where its log-likelihood differs by more."""
    similar_range: float = scaled(0.01)
    """m; or where its occlusion does."""
    similar_share: float = 0.01
    """A candidate is not fitted again where a smaller share of its rays has changed."""


@dataclass(frozen=True)
class SensorOptions:
    """The likelihood of a beam, and what is found of the sensor from the rays that meet candidates."""

    outlier_share: float = 0.005
    """Share of ranges that no surface explains, uniform over all ranges."""
    background_doubt: float = 0.05
    """Share of rays that the background, as the map has it, does not explain."""
    no_return_beyond: float = 0.5
    """Probability that a ray which leaves the map meets nothing at all."""
    censored_doubt: float = 0.1
    """Likelihood of a censored measurement (too near, no return) that nothing explains."""
    min_dropout_share: float = 0.005
    """A smaller share of dropouts counts as none: ``background_doubt`` times ``censored_doubt`` explains as many."""
    max_dropout_share: float = 0.3
    """Where a larger share of beams returns nothing, there is nothing."""
    noise_scans: int = 40
    """Scans whose neighbouring beams bound the noise."""
    max_noise_ratio: float = 2.0
    """The noise is at most so many times what the differences of neighbouring beams show."""
    min_max_noise: float = 0.01
    """m; that bound is no lower."""
    initial_noise: float = 0.03
    """m; where too few rays meet candidates to estimate it."""
    min_initial_noise: float = 0.005
    """m; lower bound of the first estimate, which contains the errors of the guesses."""
    min_initial_rays: int = 10
    """Fewer residuals give no first estimate."""
    min_noise: float = 0.002
    """m; lower bound of the noise: ranges and poses in logs are not known better."""
    search_step: float = 0.5
    """First step of the search for the noise, in its logarithm,"""
    search_refinement: float = 6.0
    """which is divided by this around the best,"""
    last_search_step: float = 0.1
    """until it is smaller than this;"""
    search_steps: int = 12
    """at most so many steps."""
    min_rays: int = 20
    """Fewer measured rays give no noise, and fewer scans no dispersion."""
    min_rays_of_scan: int = 4
    """Fewer rays of a scan give no mean error of that scan."""
    max_residual: float = 4.0
    """Standard deviations; a ray that is off by more met something else."""
    significant_dispersion: float = 1.1
    """Scans have a common error where the squares of their mean residuals exceed independent ones by this factor."""
    stretches: tuple[int, ...] = (3, 10, 30)
    """Lengths (scans) of the clusters over time for which the sandwich estimate is made."""
    min_stretches: int = 6
    """Fewer clusters give no estimate."""
    significance: float = 3.0
    """Standard deviations of the mean square of independent scores that the estimate must exceed."""
    min_score_blur: float = 0.004
    """m; silhouettes are blurred by this much at least where scores are taken."""
    footprints: tuple[float, ...] = (0.0, 0.0005, 0.001, 0.002, 0.004, 0.008, 0.016)
    """m; footprints that are tried; the first two count as none."""
    misfit_rounds: int = 2
    """How often, at most, what fits no kind is sought with the noise that is known by then."""
    same_noise: float = 0.03
    """Noise that differs by a smaller share does not make fits anew,"""
    same_dropouts: float = 0.01
    """nor do dropouts whose share differs by no more."""
    beam_parts: tuple[float, ...] = (0.0, -0.5, 0.5, -1.0, 1.0)
    """Directions within a wide beam, in half-widths, of which the nearest surface is read: the axis first, so that it
    stays where none is nearer."""
    beyond: float = 2.45
    """Range noises; a range that is more beyond a surface is not explained by that,"""
    unexplained: float = -3.0
    """nats; nor by a background whose log-likelihood is less: that is at as many range noises."""


@dataclass(frozen=True)
class ScannerOptions:
    """Errors that all beams of a scanner have in common, estimated from all candidates together."""

    deviations: float = 5.0
    """Standard deviations from 0 at which a range bias is reported: 1 in 2 million by chance."""
    considered: float = 3.0
    """The same of the bias that the first fits show: with less nothing is fitted anew to find it."""
    min_bias: float = 0.004
    """m; a smaller bias is not reported: on real logs models are not exact to less (a scanner read 2 mm, 50 std)."""
    max_bias: float = 0.05
    """m; bound of the search: real scanners state 30 mm."""
    max_step: float = 0.015
    """m; a step of Gauss and Newton's method is no larger."""
    steps: int = 5
    """The most steps; they end where one is below …"""
    last_step: float = 0.0002
    """m; … this."""
    difference: float = 0.25
    """Range noises; the step of differences by the bias."""
    agreement: float = 4.0
    """Standard deviations from the candidates' median, its scatter included, beyond which one has no part."""
    min_first_gain: float = 4.0
    """nats a candidate, times the dispersion, by which beams of a width must be likelier than without at first …"""
    min_gain: float = 10.0
    """… and once they are taken out; by chance it came to 7."""
    reaches: tuple[float, ...] = (0.0015, 0.003, 0.006, 0.012, 0.024)
    """rad; half-widths of beams that are tried: 0.09 to 1.4 degrees."""
    first_reach: float = 0.003
    """rad; where none up to this is likelier than no width, for most candidates, no others are tried."""
    refinements: int = 3
    """Halvings of the interval around the best."""
    turns: int = 3
    """Fits in a row, each with rays turned to the nearest surface of the fit before."""
    asked: int = 12
    """The most candidates that are asked, those that most rays meet: it bounds the time."""
    first_footprint: float = 0.001
    """m; the footprint is no larger where a width is searched. Where one is known it is 0: jumps show it best."""
    reach_std: float = 0.0003
    """rad; standard deviation of a half-width, and of where mixed pixels begin: how a beam's parts make one range is
    known no better …"""
    relative_reach_std: float = 0.03
    """… than this and, as a share of it, this: by how far half-widths of 0.25 to 1 degree came out too small."""
    mixed: tuple[float, ...] = (0.004, 0.008, 0.012, 0.016, 0.024)
    """rad; half-widths within which mixed pixels are counted."""
    min_mixed_share: float = 0.15
    """Share of mixed pixels, of the rays between two half-widths, from which on the wider one holds them; 0.01 to
    0.06 are outliers and errors of the map."""
    min_mixed: int = 20
    """Mixed pixels; fewer are outliers."""


@dataclass(frozen=True)
class Descent:
    """One stage of a fit: blurs (m) one after the other, at most so many steps at each, and where to end (nats)."""

    blurs: tuple[float, ...]
    steps: int
    tolerance: float


@dataclass(frozen=True)
class FitOptions:
    """Maximum likelihood by Levenberg and Marquardt's method."""

    coarse_rays: int = 800
    """Rays that starts are fitted to, about."""
    search_rays: int = 1600
    """Rays that the best of these are fitted to."""
    coarse: Descent = Descent((0.03, 0.012), 8, 0.5)
    """From starts; its first blur exceeds the errors of networks."""
    fine: Descent = Descent((0.008, 0.001), 10, 0.1)
    """From the best coarse fits."""
    last: Descent = Descent((0.012, 0.004, 0.001, 0.0003), 10, 0.1)
    """From earlier fits, with all rays."""
    information_blur: float = scaled(0.001)
    """m; information of silhouettes is asked with this blur at least: at narrower ones single jumps count for all."""
    kind_cost_margin: float = 60.0
    """nats; a kind whose coarse fit is less likely by this much than the best is not fitted to more rays."""
    start_cost_margin: float = 20.0
    """nats; nor is another fit of one kind."""
    starts_kept: int = 2
    """Coarse fits of a kind that are continued."""
    same_mode: float = 4.0
    """Standard deviations of either within which two fits are of one mode: the evidence's samples reach as far."""
    mode_cost_margin: float = 12.0
    """nats; a mode that is less likely by this much than the best one of its kind is left out: somewhat above
    EvidenceOptions.mode_margin, since modes of equal cost differ in volume."""
    modes_kept: int = 3
    """Modes of a kind that are kept: a triangle has three apexes. Bounds the time."""
    max_extent: float = scaled(1.0)
    """m; EvidenceOptions.max_extent: a fit that is larger is no shape by the prior, …"""
    too_large_nats: float = 1.0
    """nats; … and one that is not is preferred to it where it is less likely by no more."""
    scattered: int = 100
    """Shapes scattered about the best fit of a likely kind, from which it is fitted again;"""
    scatter: float = 4.0
    """their standard deviations, in those of the fit: other maxima lie 4 to 10 of them away (README's outliers)."""
    scatter_blur: float = scaled(0.004)
    """m; with which they are compared."""
    scatter_kept: int = 2
    """How many of them are fitted."""
    scatter_cost_margin: float = 3.0
    """nats; kinds whose cost is within this of the least are likely."""
    equilateral: float = 2.0
    """A triangle whose sides differ by a smaller factor may have been fitted with the wrong apex: noise of 0.25 to
    0.5 m takes sides of 0.11 and 0.21 m for each other."""
    stretch: float = 1.03
    """Factor by which an ellipse's start is longer (and shorter) than the circle that it begins with."""
    first_damping: float = 1e-2
    """Levenberg–Marquardt damping at the start."""
    min_damping: float = 1e-6
    """Its lower bound."""
    max_damping: float = 1e4
    """Damping at which a descent ends."""
    damping_after_success: float = 0.2
    """Factor of the damping after a step that gains (Marquardt 1963 has 0.1)."""
    damping_after_failure: float = 8.0
    """Factor after one that does not (10)."""
    damping_where_singular: tuple[float, float] = (10.0, 1e-3)
    """Factor, and least damping, where the damped information has no Cholesky decomposition."""
    across: float = 0.9
    """Sine of a start's turn from the guess, above which width and height are exchanged."""
    aligned: float = 0.1
    """The same, below which they are kept; in between both are the mean."""
    min_size: float = 0.02
    """m; bounds of width and height (of semi-axes) during a descent; the recorder draws no smaller ones."""
    max_size: float = scaled(1.2)
    """m."""


@dataclass(frozen=True)
class EvidenceOptions:
    """Marginal likelihoods by importance sampling."""

    sizes: tuple[float, float] = DEFAULT_SIZES
    """m; the smallest and the largest object that is wanted, by its longest side or its diameter. The prior of each
    size is scale-free over what these allow: as likely between 0.1 and 0.2 m as between 1 and 2 m."""
    size_margin: float = 1.25
    """By this factor larger or smaller ones are objects, too: where a bound is, is not meant exactly."""
    thinnest: float = 0.2
    """The prior's lower bound of each size, as a share of the smallest object."""
    max_extent: float = scaled(1.0)
    """m; no fit is larger: something above the 0.7 m of what is searched for at this scale."""
    contender: float = 7.0
    """nats; kinds within this of the best one's Laplace approximation are sampled: e^-7 is below 0.1 %."""
    mode_margin: float = 9.0
    """nats; and of each of these kinds the modes within this of its best one: Laplace's approximations of one kind's
    modes are off by some nats against each other."""
    samples: tuple[int, ...] = (300, 300, 600)
    """Samples in each round."""
    more_samples: tuple[int, ...] = (900, 1800)
    """Samples in each further round, of which there are as many as it takes until …"""
    enough_effective: float = 40.0
    """… the effective sample size of a round is this: else the posterior of a rough likelihood is too narrow."""
    degrees: float = 6.0
    """Degrees of freedom of the proposal, Student's t: heavier tails than the posterior's."""
    min_effective: float = 0.15
    """Effective share of samples, in all rounds but the last, below which weights are tempered."""
    min_effective_last: float = 0.06
    """The same in the last round."""
    tempering: float = 0.7
    """Factor of the weights' power in each step of tempering,"""
    min_power: float = 1e-3
    """which ends at this power."""
    min_std: tuple[float, ...] = (1e-4, 1e-4, 1e-3, 1e-4, 1e-4)
    """m, m, rad, m, m; lower bounds of the proposal's standard deviations."""
    max_turn: float = 0.5
    """rad; upper bound of its standard deviation in angle."""
    sure_deviations: float = 4.0
    """Standard deviations within which a ray's hit or miss must not change to be summed up once."""
    same_sizes: float = 0.0005
    """m; sizes that differ by less make a square of a rectangle: no pose is known better."""
    unseen_size: float = 0.15
    """Relative standard deviation of a size from which on no ray has seen it,"""
    unseen_margin: float = 3.0
    """and nats within which a kind that does not know a size is reported in the place of its special case: where
    that size is not seen at all, both evidences are the same but for the samples."""
    log_evidence_margin: float = 30.0
    """nats (times the dispersion); a kind whose evidence is less by this much is not fitted again."""

    @property
    def bounds(self) -> tuple[float, float]:
        """The bounds (m) of a size at this scale, as the extent that it is of."""
        smallest, largest = self.sizes
        return self.thinnest * smallest, min(self.size_margin * largest, self.max_extent)

    @property
    def smallest_extent(self) -> float:
        """The least longest side, or diameter (m), of an object that is wanted."""
        return self.sizes[0] / self.size_margin

    @property
    def log_size_density(self) -> float:
        """The log of the prior density of a size's logarithm, which is uniform over all scales."""
        smallest, largest = self.sizes
        return -math.log(math.log(self.size_margin * largest / (self.thinnest * smallest)))


@dataclass(frozen=True)
class MapOptions:
    """Which cells of a map belong to walls, and which may belong to primitives."""

    max_extent: float = scaled(0.75)
    """m; connected components that extend further are no primitives: somewhat above EvidenceOptions.max_extent."""
    min_wall: float = scaled(0.8)
    """m; a straight line with surface cells over this length is a wall: longer than any primitive."""
    max_walls: int = 16
    """Detection of walls in a map."""
    wall_width: float = 3.0
    """cells; noise bends a wall: its surface cells lie this near to its line …"""
    wall_density: float = 0.7
    """… over this share of its length at least (lines through speckle have half of that),"""
    sharp_width: float = 1.0
    """cells; or they lie this near …"""
    sharp_density: float = 0.4
    """… over this share: mappers wear holes into walls seen at a slant."""
    wall_cells: float = 3.0
    """cells; occupied cells this near to a wall's line belong to it."""
    wall_depth: float = 0.4
    """m; a wall that is free on one side only reaches so far to the other."""
    one_sided: float = 0.2
    """Share of free cells, of the other side's, below which a side is not free."""
    min_opening: float = scaled(0.1)
    """m; a wall is open where it has no cells over this length at least: noise wears smaller holes into walls."""
    min_span: float = scaled(0.4)
    """m; between openings a wall is as long at least: a primitive may stand in a doorway."""
    penetration: float = scaled(0.025)
    """m; what reaches further behind such a wall is no primitive."""
    touching: float = scaled(0.008)
    """m; a wall's cells this near to a primitive count as the primitive's."""
    moved_range: float = scaled(0.05)
    """m; a background has changed where rays end elsewhere by more …"""
    moved_share: float = 0.1
    """… for more than this share of them."""
    cleared_first: float = scaled(0.03)
    """m; occupied cells around a candidate that are its own, before it is fitted."""
    cleared: float = scaled(0.02)
    """m; and afterwards."""
    shown_cells: float = 71.0
    """Cells across the largest thing that numbers hold for: a square of 0.5 m in cells of 1 cm, or two of 0.25 m that
    touch. Larger ones are seen in coarser cells."""
    reference: float = 0.01
    """m; the side of the cells that all numbers are written for."""
    max_hollow: float = 0.6
    """Share of the cells within a component's rectangle that are free, above which it is a room or a part of one; of
    components that are too large for the map's own cells."""
    blur: float = scaled(0.1)
    """m; noise blurs a primitive so far into the map: connected cells this near are its own."""


@dataclass(frozen=True)
class LineOptions:
    """Straight lines by RANSAC."""

    trials: int = 60
    """Pairs of points tried for a line: where half of the points are on it, all miss it in 3 of 10^8 cases."""
    max_points: int = 4000
    """The most points used; of more, a random sample. Bounds the time."""
    min_inliers: float = 8.0
    """Points of a line."""
    baseline: float = 8.0
    """Widths by which a pair is apart at least: the line through nearer points is too uncertain."""
    refits: int = 3
    """Fits of a line to the points within …"""
    medians: float = 2.0
    """… so many median distances."""


@dataclass(frozen=True)
class WallOptions:
    """Straight walls behind candidates that stand close to them."""

    near: float = scaled(0.12)
    """m; walls are considered as the background of candidates this near to them,"""
    around: float = scaled(0.5)
    """m; by its cells this far around,"""
    min_length: float = scaled(0.12)
    """m; seen over this length on both sides,"""
    own: float = scaled(0.04)
    """m; leaving out cells this near to a candidate."""
    width: float = 2.0
    """cells; its cells lie this near to its line, along which noise has bent it."""
    cells: float = 3.5
    """cells; cells this near to the stretch stand for it."""
    depth: float = scaled(0.02)
    """m; a primitive may reach so far into it: its line is known no better."""
    thickness: float = 0.002
    """m; of the rectangle that stands for it."""
    beyond: float = scaled(0.15)
    """m; that reaches so far beyond a candidate on both sides."""


@dataclass(frozen=True)
class SurfaceOptions:
    """Straight walls measured by rays."""

    width: float = 3.5
    """cells; cells this near to a wall's line are the wall's: its line is known no better by them."""
    min_incidence: float = 0.2
    """Cosine; rays more oblique than this do not say where a wall is."""
    min_rays: int = 50
    """Fewer rays measure no wall."""
    clear: float = scaled(0.03)
    """m; rays that pass a candidate nearer than this may have met it."""
    iterations: int = 5
    """Of the robust regression,"""
    huber: float = 1.345
    """standard deviations from which on its residuals count less (95 % efficiency; Huber 1964)."""
    slope_precision: float = 100.0
    """A wall's direction by its cells is not changed where few rays say so: weight of a slope of 0."""
    uncertainty: float = 0.002
    """m; of a measured wall: none is straight to less."""


@dataclass(frozen=True)
class ProposalOptions:
    """Candidates from the map that the networks did not find."""

    max_proposals: int = 24
    """The largest components that are proposed: a map full of speckle has many."""
    min_extent: float = scaled(0.03)
    """m; smallest extent of a component."""
    max_extent: float = scaled(0.7)
    """m; largest one, along its longer side."""
    min_cells: int = 6
    """Cells of a component."""
    max_covered: float = 0.3
    """Share of a component's cells within a known primitive from which on it is part of that."""
    min_free: float = 0.3
    """Share of the cells around it that are free: what lies behind a wall is not seen."""
    near: float = scaled(0.03)
    """m; cells this near to a primitive count as within it."""


@dataclass(frozen=True)
class AcceptanceOptions:
    """What a candidate needs to be a detection."""

    min_log_ratio: float = 25.0
    """nats; log-likelihood ratio of the rays against nothing in its place."""
    hopeless: float = -200.0
    """nats; after the first fits, to some of the rays, candidates with less are given up."""
    max_misfit: float = 0.25
    """nats a ray; by which the map alone explains the rays that meet it better."""
    max_relative_std: float = 0.25
    """Standard deviation of a size, as a share of it."""
    min_seen: float = 0.35
    """Share of the directions around it in which rays meet it; of candidates that the networks did not find."""
    sectors: int = 24
    """Directions around the centroid that this is counted in."""
    min_kind_probability: float = 0.33
    """Posterior probability of its kind; of such candidates."""
    min_shared: float = 0.25
    """Share of the smaller area that the fit has in common with the guess; of such candidates."""
    max_shared: float = 0.25
    """Two candidates that share more of the smaller one's area are duplicates."""
    preference: float = 1.5
    """Of duplicates one that the networks found wins unless another's log-likelihood ratio is larger by this factor.
    """
    settled_probability: float = 0.95
    """A detection of an earlier run whose kind has this posterior probability keeps it."""


@dataclass(frozen=True)
class OutlineOptions:
    """Free outlines: a primitive's outline deformed by harmonics."""

    vertices: int = 64
    """Vertices that stand for a deformed outline, about."""
    harmonics: int = 16
    """Harmonics of the deformation."""
    amplitudes: tuple[float, ...] = (0.1, 0.5)
    """Standard deviations of the first harmonic under the priors that are tried, as shares of the radius,"""
    decay: float = 2.0
    """of harmonic k by k to the power of minus this."""
    growth: tuple[float, float] = (-2.0, 1.0)
    """Bounds of the logarithm of a radius over the primitive's."""
    descent: Descent = Descent((0.012, 0.004, 0.001), 12, 0.1)
    """From the primitive's outline."""
    test_blur: float = scaled(0.012)
    """m; of silhouettes in the score test: further than from there no step of it reaches."""
    suspicious: float = 5.0
    """nats; only where the score test promises a gain of so much is a free outline fitted."""
    least_blur: float = 0.0005
    """m; of silhouettes: at narrower ones single rays count for all."""
    footprint: float = 0.002
    """m; half-width of silhouettes while the sensor's own is not known."""
    first_damping: float = 1e-2
    """As those of FitOptions."""
    min_damping: float = 1e-6
    max_damping: float = 1e4
    damping_after_success: float = 0.2
    damping_after_failure: float = 8.0
    information_blur: float = scaled(0.001)
    """m; as FitOptions.information_blur."""


@dataclass(frozen=True)
class PolygonOptions:
    """Free polygons, from the contour of a candidate's cells."""

    around: float = scaled(0.08)
    """m; the contour is searched this far around the candidate's circle,"""
    around_cells: float = 6.0
    """cells; and this far at least."""
    others: float = 1.5
    """cells; cells this near to another candidate are that one's,"""
    wall: float = 2.5
    """cells; and those this near to a wall's line the wall's."""
    simplification: float = 1.2
    """cells; tolerance of the contour's first polygon."""
    vertices: tuple[int, int] = (3, 60)
    """Fewest and most vertices."""
    round_vertices: tuple[int, ...] = (5, 6, 8)
    """Vertices of polygons that begin as circles or ellipses."""
    search_rays: int = 1500
    """Rays that the number of vertices is chosen with, about."""
    coarse: Descent = Descent((0.012, 0.004, 0.001), 8, 0.3)
    """From the contour, to some of the rays."""
    reduction: Descent = Descent((0.004, 0.001), 5, 0.3)
    """With a vertex less."""
    fine: Descent = Descent((0.004, 0.001), 8, 0.1)
    """To all rays."""
    tries: int = 3
    """Vertices whose removal is tried, those that span the smallest triangles, before all stay."""
    pull: float = scaled(0.04)
    """m; standard deviation of vertices about where a descent begins: the contour is no further off."""
    spread: float = scaled(0.35)
    """m; standard deviation of vertices about the first one under the prior: half of EvidenceOptions.max_extent."""
    vertex_odds: float = 2.0
    """By this factor a polygon with one more vertex is less likely a priori."""
    least_blur: float = 0.0005
    """m; of silhouettes."""
    information_blur: float = scaled(0.001)
    """m; as FitOptions.information_blur."""
    first_damping: float = 1e-2
    """As those of FitOptions."""
    min_damping: float = 1e-6
    max_damping: float = 1e4
    damping_after_success: float = 0.2
    damping_after_failure: float = 8.0


@dataclass(frozen=True)
class TemplateOptions:
    """Shapes of few parameters that are none of the kinds."""

    rays: tuple[int, int, int] = (700, 2000, 8000)
    """Rays of the three stages, about."""
    screen: float = 60.0
    """nats; starts that are less likely than the kind by more are left out."""
    first: Descent = Descent((0.012,), 3, 1.0)
    """First stage: from starts."""
    first_screen: float = 30.0
    """nats; of the rest those that are then less likely than the kind by more,"""
    kept: int = 8
    """and all but so many."""
    coarse: Descent = Descent((0.012,), 6, 0.2)
    """Second stage."""
    margin: float = 6.0
    """nats; templates whose predicted evidence is less than the kind's by more are left out."""
    fitted: int = 4
    """Templates that are fitted to all rays at most, those of the largest predicted evidence."""
    fine: Descent = Descent((0.012, 0.006, 0.003, 0.001), 12, 0.05)
    """Third stage."""
    least_blur: float = 0.0005
    """m; of silhouettes."""
    information_blur: float = scaled(0.001)
    """m; as FitOptions.information_blur."""
    min_size: float = 0.02
    """m; as FitOptions.min_size."""
    max_log_odds: float = 6.0
    """nats; bound of the logarithm of a share's odds: 0.25 % is as good as nothing, 99.75 % as good as all."""
    first_damping: float = 1e-2
    """As those of FitOptions."""
    min_damping: float = 1e-6
    max_damping: float = 1e4
    damping_after_success: float = 0.2
    damping_after_failure: float = 8.0


@dataclass(frozen=True)
class ContactOptions:
    """When a candidate is a part of something larger."""

    occluder_distance: float = scaled(2.5)
    """m; primitives that are further away are left in the map."""
    edge: float = 0.5
    """cells; unexplained cells touch a candidate where they are further off its outline than this"""
    touch: float = 2.5
    """cells; and no further than this."""
    far: float = scaled(0.15)
    """m; cells connected with these count up to this far from the outline,"""
    far_cells: float = 8.0
    """cells; and up to this far at least."""
    own: float = scaled(0.02)
    """m; another primitive explains cells this near,"""
    own_cells: float = 1.5
    """cells; or this near;"""
    wall_width: float = scaled(0.035)
    """m; a wall those this near to its line,"""
    wall_width_cells: float = 1.6
    """cells; or this near."""
    wall_extension: float = 0.2
    """m; a wall may go on so far behind a candidate, beyond where it is seen."""
    wall_depth: float = scaled(0.02)
    """m; a candidate that reaches further behind a wall's line is not explained by it,"""
    wall_depth_cells: float = 0.4
    """cells; this far at least."""
    strip: tuple[float, ...] = (2.0, 3.0, 4.0)
    """cells; distances from a wall's line of the strip beside a candidate …"""
    free_share: float = 0.5
    """… of which more than this share is free: else the candidate is a part of what stands behind the wall."""
    beside: float = 1.5
    """cells; the strip begins this far beside the candidate."""
    cleared: float = scaled(0.02)
    """m; cells this near to primitives are theirs."""
    passing: float = 0.002
    """m; rays whose line passes a candidate by more count."""
    side_strip: tuple[float, ...] = (0.5, 1.5, 2.5, 3.5)
    """cells; distances from a side at which free cells are sought beside it,"""
    side_ends: float = 2.0
    """cells; its ends left out,"""
    side_cells: int = 4
    """cells; where so many are left."""
    flush_wall: float = 1.5
    """cells; what lies this near to a wall's line is the wall's, where no ray saw it."""
    flush_share: float = 0.8
    """Share of a side beside which no cell is free, and another thing's cells are, where it is flush with that."""
    min_nats: float = 20.0
    """nats; what touches a candidate makes it a part where the rays are likelier with it by more. Primitives that
    stand alone or at walls come to 1 at most (trial of 331 and 114)."""


@dataclass(frozen=True)
class OtherOptions:
    """When a candidate is none of the kinds."""

    prior: float = 1 / 6
    """Prior probability of «none of the kinds», as likely as each of the five, which share the rest evenly: where few
    rays tell nothing, it decides; that of a log of many things is estimated from all of them."""
    bagged_dispersion: float = 2.0
    """Where scans disperse by more, a score is the mean of those by all rays and by parts of the scans; by hand."""
    bagged_parts: int = 2
    """Into how many parts; every so many-th scan makes one."""
    bagged_doubt: float = 0.99
    """What is more likely than this none of the kinds is not asked by parts."""
    share_rounds: int = 30
    """Rounds of expectation and maximisation in which it is."""
    min_difference: float = 0.025
    """A free outline that has more than 1 minus this in common with a kind (IoU) is that kind: real things are not
    exact."""
    polygon_handicap: float = 5.0
    """nats; by which polygons are less likely a priori than deformed primitives: their number of vertices is chosen
    by the same rays."""
    template_handicap: float = 1.0
    """nats; by which templates are less likely a priori than deformed primitives: single shapes of them look like
    kinds."""
    overwhelming: float = 20.0
    """nats; where another alternative is likelier than the kinds by more, no templates are fitted."""
    flush: float = 1.0
    """Odds that a thing with a side flush with a wall, or with another thing, is a part of it: a free-standing one
    seldom stands so exactly, parts always do, and the rays cannot tell them apart."""
    min_gain: float = 5.0
    """nats; only where the score test promises a gain of so much are free outlines fitted."""


@dataclass(frozen=True)
class TouchingOptions:
    """When what no kind fits is separated into two things that touch."""

    around: float = 1.5
    """cells; a component of the map belongs to a candidate where its cells are this near to it."""
    max_radius: float = scaled(0.7)
    """m; of the circle around a component; larger ones are no two primitives: EvidenceOptions.max_extent."""
    reach: float = scaled(0.03)
    """m; rays that pass that circle at this distance are needed."""
    unexplained: float = 0.25
    """Share of a component's cells that no candidate covers, above which two things are tried although each
    candidate fits a kind."""
    simplification: float = 0.7
    """cells; tolerance of one of the contours that are cut: a neck may be a cell deep."""
    min_turn: float = 0.25
    """rad; an outline is concave where it turns inwards by more."""
    min_share: float = 0.06
    """A part has this share of the area at least."""
    max_mismatch: float = 0.14
    """Area by which parts and primitives differ, as a share of the whole: above this a partition is not tried."""
    max_cuts: int = 8
    """Cuts that are compared by area: the shortest, for the outline that they cut off."""
    round_vertices: int = 24
    """Vertices that stand for round shapes there."""
    tries: int = 3
    """Partitions that are fitted to the rays, those whose parts are most like primitives,"""
    alike: float = 0.8
    """leaving out those whose parts have more than this in common (IoU) with another's."""
    rounds: int = 3
    """Fits of the parts beside each other; all but the last are searches."""
    min_rays: int = 40
    """Rays that meet each part."""
    min_nats: float = 20.0
    """nats; by which one thing is likelier a priori than two that touch, and that are tried in several ways."""
    sure_nats: float = 100.0
    """nats; parts that are likelier than one thing by more are not tried otherwise."""
    max_shared: float = 0.06
    """Share of the smaller area that parts have in common at most: things do not overlap."""
    aligned: float = 0.05
    """rad; sides that differ by less in direction are parallel."""
    coincidence: float = scaled(0.004)
    """m; lines, or axes, that are no further apart are the same."""
    gap: float = scaled(0.02)
    """m; parts that are further apart do not touch."""


@dataclass(frozen=True)
class StandingOptions:
    """When the rays of some scans contradict a fit to those of others."""

    min_nats_against: float = 25.0
    """nats; it is gone where the rays are likelier by more without it: AcceptanceOptions.min_log_ratio."""
    min_gain: float = 60.0
    """nats; it was moved where the rays are likelier by more with it elsewhere …"""
    min_displacement: float = 0.006
    """m; … by more than this. Of things that stand the gain is up to some 200 nats, by less than 3 mm, or the
    displacement up to 30 mm, by less than 20 nats (driven sessions, range noise of 50 mm)."""


@dataclass(frozen=True)
class RefinementOptions:
    """All numbers of refinement."""

    rays: RayOptions = field(default_factory=RayOptions)
    sensor: SensorOptions = field(default_factory=SensorOptions)
    scanner: ScannerOptions = field(default_factory=ScannerOptions)
    fit: FitOptions = field(default_factory=FitOptions)
    evidence: EvidenceOptions = field(default_factory=EvidenceOptions)
    map: MapOptions = field(default_factory=MapOptions)
    lines: LineOptions = field(default_factory=LineOptions)
    walls: WallOptions = field(default_factory=WallOptions)
    surfaces: SurfaceOptions = field(default_factory=SurfaceOptions)
    proposals: ProposalOptions = field(default_factory=ProposalOptions)
    acceptance: AcceptanceOptions = field(default_factory=AcceptanceOptions)
    outline: OutlineOptions = field(default_factory=OutlineOptions)
    polygon: PolygonOptions = field(default_factory=PolygonOptions)
    templates: TemplateOptions = field(default_factory=TemplateOptions)
    contact: ContactOptions = field(default_factory=ContactOptions)
    other: OtherOptions = field(default_factory=OtherOptions)
    touching: TouchingOptions = field(default_factory=TouchingOptions)
    standing: StandingOptions = field(default_factory=StandingOptions)
    closed_world: bool = False
    """Whether all there is are the kinds and walls: nothing is held against «none of the kinds»."""
    rounds: int = 2
    """Joint fits of all candidates once duplicates are gone."""
    converged: float = 0.002
    """m, rad; rounds end where no parameter moves by more."""

    def with_rays_for(self, candidates: int) -> RefinementOptions:
        """Return the numbers with no more rays for each of so many candidates than all of them may have together."""
        rays = self.rays
        most = min(rays.max_rays, max(rays.max_total // max(candidates, 1), rays.min_rays))
        return replace(self, rays=replace(rays, max_rays=most))

    def at_scale(self, factor: float) -> RefinementOptions:
        """Return the numbers for things that are so many times as large, in cells that are.

        Args:
            factor: The side of a cell over 1 cm.

        Returns:
            The numbers.
        """
        return self if factor == 1 else _at_scale(self, factor)


def _at_scale(options: Any, factor: float) -> Any:
    """Return options, and those in them, with all lengths multiplied that are marked, and all blurs of descents."""
    changed: dict[str, Any] = {}
    for one in fields(options):
        value = getattr(options, one.name)
        if isinstance(value, Descent):
            changed[one.name] = replace(value, blurs=tuple(factor * blur for blur in value.blurs))
        elif is_dataclass(value):
            changed[one.name] = _at_scale(value, factor)
        elif SCALED in one.metadata:
            changed[one.name] = factor * value
    return replace(options, **changed)


DEFAULTS = RefinementOptions()
