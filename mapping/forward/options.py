"""Options of the forward mapper: every number that its results depend on, but for the layout of its kernels."""

from __future__ import annotations

from dataclasses import dataclass, field

from mapping.forward.calibration import CalibrationOptions
from mapping.forward.likelihood import RayModel


@dataclass(frozen=True, slots=True)
class ForwardOptions:
    """Options of the forward mapper. Where no source is named, a number was set by hand."""

    ray_model: RayModel = field(default_factory=RayModel)
    """Parameters of the sensor model that are not estimated."""

    calibration: CalibrationOptions = field(default_factory=CalibrationOptions)
    """How stopping probabilities become probabilities of occupancy."""

    # The sieve: the restriction to smooth maps.

    smoothing: float = 0.3
    """Width of the sieve's Gaussian kernel over sqrt(sigma * resolution). Of 0.2, 0.3 and 0.4 the middle one gave the
    best maps on recorded sessions (docs/forward.md, «Sieve»)."""

    min_smoothing_cells: float = 0.3
    """A kernel that is narrower than this (cells) is a single weight: no smoothing."""

    kernel_truncation: float = 2.5
    """The kernel ends at this many standard deviations."""

    sieve_variance: float = 3.5
    """The sieve smooths the map, which lowers the estimated noise variance by this times the kernel's own. Measured
    on seeds 0 to 3 of recorded sessions (docs/forward.md, «Range noise»)."""

    min_stopping: float = 1e-7
    """Lower bound of a cell's stopping probability o, and of the parameters p that are not fixed at 0."""

    max_stopping: float = 1 - 1e-4
    """Upper bound of a cell's stopping probability o and parameter p."""

    # The range noise.

    min_outlier_share: float = 1e-4
    """Lower bound of the outlier share, and its value before it is estimated."""

    max_outlier_share: float = 0.3
    """Upper bound of the outlier share."""

    min_dropout_share: float = 1e-4
    """Lower bound of the share of dropouts, where any ray returned nothing; else it is 0."""

    max_dropout_share: float = 0.3
    """Upper bound of the share of dropouts, and of its first value: below 1 - ``RayModel.hit_beyond``, so that where
    nothing at all returns free paths are likelier."""

    min_noise_cells: float = 0.15
    """Lower bound of the estimated noise (cells)."""

    max_noise: float = 5.0
    """Upper bound of the estimated noise (m)."""

    min_given_noise_cells: float = 0.3
    """Noise that is given counts as this many cells at least: a surface may be that far from its cell's centre."""

    min_stops: float = 5.0
    """The noise is not estimated from fewer expected stops of rays in the grid."""

    max_start_ratio: float = 2.0
    """The fit starts with at least the noise that neighbouring beams show, and at most this many times as much."""

    default_noise_cells: float = 10.0
    """The noise (cells) before there is any measurement."""

    hold_out_every: int = 5
    """One in this many rays is held out: the noise is estimated from rays that the map was not fitted to."""

    hold_out_passes: int = 3
    """Number of steps of expectation-maximisation that estimate the noise from the held-out rays, the map fixed."""

    hold_out_min_rays: int = 1000
    """With fewer rays than this none are held out."""

    max_range: float = 1000.0
    """A sensor without a range_max is assumed to have this one (m)."""

    # Expectation-maximisation from coarse to fine.

    initial_stopping: float = 0.02
    """Parameter p of every cell before the fit, times the coarsest level's factor; on the streaming map it is always
    twice this, however large its cells are."""

    tolerance: float = 5e-4
    """The finest level has converged when a pass raises the mean log-likelihood of a ray by less (nats)."""

    coarse_tolerance: float = 2e-3
    """The same for the other levels (nats)."""

    max_passes: tuple[int, ...] = (6, 10, 16, 16)
    """Largest number of passes on the level whose cells are 1, 2, 4, 8 times as large as the map's, and more."""

    final_passes: int = 3
    """Largest number of passes over all rays at the end."""

    over_relaxation: int = 3
    """Exponent of the M step's odds ratio (Salakhutdinov and Roweis 2003); 1 is plain expectation-maximisation. A
    step that lowers the likelihood is undone, and those that follow on the level are plain."""

    min_coarsest_factor: int = 4
    """The coarsest level's cells are at least this many times as large as the map's."""

    max_coarsest_factor: int = 8
    """The coarsest level's cells are at most this many times as large as the map's."""

    coarsest_noise_cells: float = 4.0
    """Between the two, the coarsest level is doubled while the noise is larger than this many of its cells."""

    thinning_rays: int = 20_000
    """With more rays than this, passes before the final ones take a part of them."""

    coarsest_stride: int = 4
    """The coarsest level then takes one in this many rays."""

    stride: int = 2
    """The other levels then take one in this many rays."""

    negligible_stopping: float = 1e-4
    """Parameters p that start on a level, from the coarser one's, with no more than this are fixed at 0 there. The
    stopping probability o of such a cell follows from its neighbours' p, and is no less than ``min_stopping``."""

    # While scans stream in: stepwise expectation-maximisation.

    streaming_cells: int = 120_000
    """The streaming map's cells are twice as large as the map's; larger where it would have more cells than this."""

    revisited_rays: int = 256
    """Number of earlier rays that each scan's step takes again."""

    # Limits of memory.

    max_cells: int = 50_000_000
    """A larger map is refused."""

    noise_cells: int = 4_000_000
    """Where only the noise is estimated, cells are made larger until the map has no more than this many."""


DEFAULTS = ForwardOptions()
