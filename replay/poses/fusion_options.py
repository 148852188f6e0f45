"""What poses are fused from, what is known of the sensors' noise, and the numbers of the algorithm."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

SENSORS = ODOM, GPS, COMPASS = ("odom", "gps", "compass")
"""The sensors that poses are fused from."""


@dataclass(frozen=True)
class SensorNoise:
    """Standard deviations of the sensors; None: to be estimated from the log.

    Attributes:
        position_std: Of position fixes, along each axis (m).
        heading_std: Of compass headings (rad).
        odometry_translation_std: Of the odometry's position after one metre straight on, along each axis (m). Without
            odometry: of a random walk after one second.
        odometry_rotation_std: Of the odometry's heading after one metre straight on (rad). Without odometry: of a
            random walk after one second.
        heading_bias: The constant offset of all compass headings (rad).
    """

    position_std: float | None = None
    heading_std: float | None = None
    odometry_translation_std: float | None = None
    odometry_rotation_std: float | None = None
    heading_bias: float | None = None


@dataclass(frozen=True)
class FusionInputs:
    """What poses are fused from.

    Attributes:
        sensors: Which of SENSORS are used, where the log has them.
        gps_topic: The topic of position fixes; None: found by type and name.
        compass_topic: The topic of north vectors; None: found by type and name.
        noise: What is known of the sensors' noise.
    """

    sensors: tuple[str, ...] = SENSORS
    gps_topic: str | None = None
    compass_topic: str | None = None
    noise: SensorNoise = field(default_factory=SensorNoise)


@dataclass(frozen=True)
class NoiseEstimationOptions:
    """The numbers of the maximum-likelihood estimate of the noise (see :mod:`replay.poses.noise_estimation`).

    All but ``score_threshold`` are set by hand.
    """

    prior_log_std: float = 1.5
    """Standard deviation of the prior on each parameter's logarithm, around its initial value (nepers)."""

    max_iterations: int = 15

    tolerance: float = 1e-3
    """The iteration ends when a step changes no logarithm (nepers) and no bias (rad) by more."""

    max_step: float = 1.5
    """A step changes no logarithm (nepers) and no bias (rad) by more."""

    min_step_share: float = 0.05
    """A step is halved while the likelihood falls, down to this share of it."""

    log_difference: float = 0.05
    """Half the interval of the central differences in a logarithm (nepers)."""

    bias_difference: float = 0.005
    """Half the interval of the central differences in the heading bias (rad)."""

    ridge: float = 1e-9
    """Added to the information's diagonal, so that it can be inverted."""

    max_nodes: int = 20_000
    """The noise is estimated from at most about so many nodes with measurements, evenly spread."""

    score_threshold: float = 12.0
    """A heading bias is estimated where its score statistic exceeds this: a 1 in 2000 event (chi squared, one degree
    of freedom)."""

    min_std: float = 1e-5
    max_std: float = 1e3
    """Bounds of all standard deviations (m, rad)."""


@dataclass(frozen=True)
class FusionOptions:
    """The numbers of the filter and smoother (see :class:`replay.poses.fusion.Fusion`)."""

    fix_gate: float = 13.8
    """Squared normalised innovation beyond which a fix is rejected: 1 in 1000 (chi squared, two degrees)."""

    heading_gate: float = 10.8
    """Squared normalised innovation beyond which a heading is rejected: 1 in 1000 (chi squared, one degree)."""

    max_rejections: int = 20
    """After so many rejections in a row the robot is taken to have been moved: the covariance is inflated, and the
    next measurement used; set by hand."""

    min_step_variance: float = 1e-10
    """Process noise of each step at least (m^2, rad^2), so that covariances stay invertible; set by hand."""

    rotation_distance: float = 0.03
    """The distance (m) that a turn by one radian counts as in the odometry's variances: about half the axle of the
    recorder's robot (0.053 m); set by hand."""

    idle_distance: float = 4e-4
    """The distance (m) that a second counts as in the odometry's variances, moving or not: with the default noise,
    1 mm of standard deviation after one second; set by hand."""

    default_odometry_std: tuple[float, float] = (0.05, math.radians(2))
    """The odometry's noise after one metre (m, rad) where a log does not determine it: the recorder's default."""

    default_walk_std: tuple[float, float] = (0.1, math.radians(20))
    """The random walk after one second (m, rad) of a robot without odometry, where a log does not determine it; set
    by hand."""

    default_position_std: float = 1.0
    """The fixes' initial noise (m) where there are too few to show any; set by hand."""

    default_heading_std: float = 0.1
    """The headings' initial noise (rad) where there are too few to show any; set by hand."""

    initial_readings: int = 20
    """The initial pose is found from the first so many fixes and headings; set by hand."""

    initial_known_std: float = 1e-5
    """Standard deviation (m, rad) of an initial pose that defines the map frame, since no sensor is absolute."""

    initial_free_std: float = 1.0
    """Standard deviation (m, rad) of the initial pose in the frame of a map that scans are matched with; set by hand:
    far above what a scan leaves open."""

    initial_compass_std: float = 0.5
    """Standard deviation of the initial heading (rad) from a compass; set by hand."""

    initial_aligned_std: float = 1.0
    """Standard deviation of the initial heading (rad) from the alignment of odometry and fixes; set by hand."""

    initial_position_std: tuple[float, float] = (1.0, 10.0)
    """Standard deviation of the initial position from fixes: a constant (m), and a multiple of the fixes' noise; set
    by hand."""

    alignment_ratio: float = 5.0
    """Odometry and fixes are aligned once the robot has come so many times as far as the fixes' noise; set by
    hand."""

    estimation: NoiseEstimationOptions = field(default_factory=NoiseEstimationOptions)
