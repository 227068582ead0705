"""A simulated laser scanner."""

from dataclasses import dataclass
from math import pi

import numpy as np
from numpy.typing import NDArray

from clients.world import World
from gpom_core.errors import ConfigurationError
from gpom_core.scan import Pose2D


@dataclass(frozen=True, slots=True)
class RangeSensor:
    """What the scanner can do.

    Attributes:
        beams: per scan.
        fov_rad: spread evenly; the full circle by default.
        range_min_m: nearer surfaces read -inf.
        range_max_m: farther surfaces read +inf.
        noise_std_m: of a range.
        dropout_probability: of a beam to read NaN.
        missed_probability: of a beam to miss a surface and read +inf, as on glass.

    Raises:
        ConfigurationError: a number is out of range.
    """

    beams: int = 360
    fov_rad: float = 2 * pi
    range_min_m: float = 0.05
    range_max_m: float = 12.0
    noise_std_m: float = 0.01
    dropout_probability: float = 0.005
    missed_probability: float = 0.0

    def __post_init__(self) -> None:
        checks = {
            "at least 2 beams": self.beams >= 2,
            "0 < fov_rad <= 2 pi": 0.0 < self.fov_rad <= 2 * pi,
            "0 <= range_min_m < range_max_m": 0.0 <= self.range_min_m < self.range_max_m < np.inf,
            "noise_std_m >= 0": 0.0 <= self.noise_std_m < np.inf,
            "probabilities from 0 to 1": all(
                0.0 <= p <= 1.0 for p in (self.dropout_probability, self.missed_probability)
            ),
        }
        for rule, holds in checks.items():
            if not holds:
                message = f"the simulated sensor is impossible: expected {rule}"
                raise ConfigurationError(message)

    @property
    def angle_min_rad(self) -> float:
        """Direction of the first beam in the frame of the sensor."""
        return -self.fov_rad / 2

    @property
    def angle_increment_rad(self) -> float:
        """From beam to beam; on a full circle the last beam is not the first again."""
        full = self.fov_rad == 2 * pi
        return self.fov_rad / (self.beams if full else self.beams - 1)

    def measure(self, world: World, pose: Pose2D, rng: np.random.Generator) -> NDArray[np.float32]:
        """Measure once: (n,) ranges in m, as REP 117."""
        first = pose.yaw_rad + self.angle_min_rad
        angles = first + self.angle_increment_rad * np.arange(self.beams)
        ranges_m = world.cast((pose.x_m, pose.y_m), angles)
        ranges_m += rng.normal(0.0, self.noise_std_m, self.beams)
        missed = rng.random(self.beams) < self.missed_probability
        dropped = rng.random(self.beams) < self.dropout_probability
        ranges_m[(ranges_m > self.range_max_m) | missed] = np.inf
        ranges_m[ranges_m < self.range_min_m] = -np.inf
        ranges_m[dropped] = np.nan
        return ranges_m.astype(np.float32)
