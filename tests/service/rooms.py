"""Scans of a square room, 6 m wide, centred at the origin: what tests feed the service."""

from math import pi

import numpy as np

from gpom_core import wire
from gpom_core.scan import Pose2D, Scan

HALF_M = 3.0
BEAMS = 180
ANGLE_MIN_RAD = -pi + 0.01  # no beam is parallel to a wall


def scan_at(
    x: float = 0.0, y: float = 0.0, *, seq: int = 1, boot: int = 1, room=(0.0, 0.0), **fields
) -> Scan:
    """Every beam ends at a wall; the room may be centred elsewhere."""
    angles = ANGLE_MIN_RAD + 2.0 * pi / BEAMS * np.arange(BEAMS)
    along = np.column_stack([np.cos(angles), np.sin(angles)])
    position = np.array([x, y]) - room
    ranges = np.min((np.sign(along) * HALF_M - position) / along, axis=1)
    return Scan(
        pose=Pose2D(x, y, 0.0),
        ranges_m=ranges,
        angle_min_rad=ANGLE_MIN_RAD,
        angle_increment_rad=2.0 * pi / BEAMS,
        range_min_m=0.05,
        range_max_m=20.0,
        seq=seq,
        boot=boot,
        **fields,
    )


def payload_at(x: float = 0.0, y: float = 0.0, *, seq: int = 1, boot: int = 1, **fields) -> bytes:
    """The same, as it travels."""
    return wire.encode(scan_at(x, y, seq=seq, boot=boot, **fields))
