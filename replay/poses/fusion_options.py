"""What poses are fused from, what is known of the sensors' noise, and the numbers of the algorithm."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

SENSORS = ODOM, GPS, COMPASS, IMU = ("odom", "gps", "compass", "imu")
"""The sensors that poses are fused from."""


class Wander(NamedTuple):
    """An error that wanders: a first-order Gauss-Markov process.

    Attributes:
        std: Its standard deviation (m along each axis, or rad).
        time: The time (s) after which 1/e of it is left.
    """

    std: float
    time: float


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
        heading_bias: The constant offset of all headings (rad).
        position_wander: What errors of fixes have in common for a while.
        heading_wander: What errors of headings have in common for a while.
        distance_scale: The factor of the odometry's distances; None where it is 1.
        turn_scale: That of its turns.
    """

    position_std: float | None = None
    heading_std: float | None = None
    odometry_translation_std: float | None = None
    odometry_rotation_std: float | None = None
    heading_bias: float | None = None
    position_wander: Wander | None = None
    heading_wander: Wander | None = None
    distance_scale: float | None = None
    turn_scale: float | None = None


@dataclass(frozen=True)
class FusionInputs:
    """What poses are fused from.

    Attributes:
        sensors: Which of SENSORS are used, where the log has them.
        gps_topic: The topic of position fixes; None: found by type and name.
        compass_topic: The topic of north vectors; None: found by type and name.
        imu_topic: The topic of an IMU's orientations; None: found by type. They are used where there is no compass.
        noise: What is known of the sensors' noise.
    """

    sensors: tuple[str, ...] = SENSORS
    gps_topic: str | None = None
    compass_topic: str | None = None
    imu_topic: str | None = None
    noise: SensorNoise = field(default_factory=SensorNoise)


@dataclass(frozen=True)
class NoiseEstimationOptions:
    """The numbers of the maximum-likelihood estimate of the noise (see :mod:`replay.poses.noise_estimation`).

    All but ``score_threshold`` are set by hand.
    """

    prior_log_std: float = 0.75
    """Standard deviation of the prior on each standard deviation's logarithm, around its initial value (nepers)."""

    prior_time_std: float = 3.0
    """That of the prior on the logarithms of time constants (nepers)."""

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

    max_time: float = 1e9
    """Bound of time constants (s)."""

    prior_scale_std: float = 0.1
    """Standard deviation of the prior on the logarithms of the odometry's scales, around 1 (nepers)."""

    scale_difference: float = 2e-3
    """Half the interval of the central differences in the logarithm of a scale (nepers)."""

    wander_gain: float = 6.5
    """Errors are taken to wander where that lowers minus twice the log-posterior by more: 1 in 26 (chi squared, with
    two degrees of freedom), since without it all poses would be too sure."""

    scale_gain: float = 15.0
    """Scales of the odometry are corrected where that lowers minus twice the log-posterior by more: a 1 in 2000 event
    (chi squared, two degrees of freedom)."""

    stated_log_std: float = 0.5
    """Standard deviation of the logarithm of the fixes' error around the one that their receiver states (nepers)."""

    wander_nodes: int = 4_000
    """Wandering errors are estimated from at most about so many nodes with measurements."""

    least_scale: float = 2e-3
    """Scales of the odometry that differ from 1 by less are left at 1."""


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

    wander_times: tuple[float, ...] = (5.0, 60.0)
    """Time constants (s) of a wandering error that the estimate begins at, one after the other; set by hand."""

    default_imu_wander: tuple[float, float] = (1.0, 1e5)
    """How an IMU's headings wander: nothing is known of where their 0 is (rad), and the time constant (s) that the
    estimate begins at is that of a drift by 0.035 rad in a minute; set by hand."""

    max_fix_scale: float = 100.0
    """A fix's stated standard deviation counts as at most so many times the median one, and no less than one of so
    many of it; set by hand."""

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

    max_smoothings: int = 8
    """Poses are smoothed at most so often, each time linear about the headings of the one before (Bell, 1994); set by
    hand."""

    linear_heading: float = 0.05
    """They are smoothed again where these change a heading by more (rad); set by hand."""

    least_gain: float = 1.05
    """Poses are fused unasked where that makes them surer by this factor (Fusion.gain_over_odometry); set by hand."""

    alignment_ratio: float = 5.0
    """Odometry and fixes are aligned once the robot has come so many times as far as the fixes' noise; set by
    hand."""

    estimation: NoiseEstimationOptions = field(default_factory=NoiseEstimationOptions)


DEFAULTS = FusionOptions()
