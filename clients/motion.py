"""How a robot drives along a way of straight pieces: round corners, even speed."""

from dataclasses import dataclass
from math import pi

import numpy as np

from clients.world import Floats
from gpom_core.scan import Pose2D

CORNER_CUT_M = 0.5
"""A corner is rounded from this far before it; the path then stays within half of that of it."""

_STEP_M = 0.03
_SHARPEST_ROUNDED_RAD = 2.6  # beyond, the robot turns on the spot


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses over time.

    Attributes:
        times_s: (M,) growing, from 0.
        xy_m: (M, 2).
        yaws_rad: (M,) without jumps.
    """

    times_s: Floats
    xy_m: Floats
    yaws_rad: Floats

    @property
    def duration_s(self) -> float:
        """From the first to the last pose."""
        return float(self.times_s[-1])

    def pose(self, time_s: float) -> Pose2D:
        """Give the pose at a time, held at both ends."""
        x_m, y_m, yaw_rad = (
            float(np.interp(time_s, self.times_s, values))
            for values in (self.xy_m[:, 0], self.xy_m[:, 1], self.yaws_rad)
        )
        return Pose2D(x_m, y_m, yaw_rad)


def round_corners(corners_m: Floats, cut_m: float = CORNER_CUT_M) -> Floats:
    """Turn a polyline (K, 2) into closely spaced points, each corner a parabola.

    The parabola lies in the triangle of the corner and its two cuts, so the path never leaves the
    polyline by more than half of `cut_m`. Reversals stay sharp.
    """
    pieces = [corners_m[:1]]
    for before, corner, after in zip(corners_m, corners_m[1:], corners_m[2:], strict=False):
        arrives, leaves = corner - before, after - corner
        reach = min(cut_m, float(np.linalg.norm(arrives)) / 2, float(np.linalg.norm(leaves)) / 2)
        start = corner - reach * arrives / np.linalg.norm(arrives)
        end = corner + reach * leaves / np.linalg.norm(leaves)
        turn = abs(_wrap(np.arctan2(*leaves[::-1]) - np.arctan2(*arrives[::-1])))
        if turn > _SHARPEST_ROUNDED_RAD:
            pieces.append(corner[None])
            continue
        share = np.linspace(0.0, 1.0, 12)[:, None]
        pieces.append((1 - share) ** 2 * start + 2 * share * (1 - share) * corner + share**2 * end)
    pieces.append(corners_m[-1:])
    return _resample(np.concatenate(pieces))


def drive(
    path_m: Floats, *, speed_m_s: float, turn_rate_rad_s: float, start_yaw_rad: float | None = None
) -> Trajectory:
    """Drive along closely spaced points (M, 2), as fast as speed and turn rate allow.

    Args:
        path_m: at least two points.
        speed_m_s: on a straight line.
        turn_rate_rad_s: at most; a sharp corner is turned on the spot.
        start_yaw_rad: heading before the first point; None to start along the path.
    """
    steps = np.diff(path_m, axis=0)
    headings = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    first = headings[0] if start_yaw_rad is None else start_yaw_rad
    headings += 2 * pi * np.round((first - headings[0]) / (2 * pi))
    # At each point the robot first turns to the next heading, then drives on with it.
    turns_s = np.abs(np.diff(headings, prepend=first)) / turn_rate_rad_s
    drives_s = np.linalg.norm(steps, axis=1) / speed_m_s
    times_s = np.concatenate([[0.0], np.cumsum(np.column_stack([turns_s, drives_s]).ravel())])
    xy_m = np.repeat(path_m, 2, axis=0)[:-1]
    yaws_rad = np.concatenate([[first], np.repeat(headings, 2)])
    return Trajectory(times_s, xy_m, yaws_rad)


def _resample(points_m: Floats) -> Floats:
    lengths = np.linalg.norm(np.diff(points_m, axis=0), axis=1)
    points_m = points_m[np.concatenate([[True], lengths > 1e-9])]
    along = np.concatenate([[0.0], np.cumsum(lengths[lengths > 1e-9])])
    # The given points stay, so that a sharp corner is not cut.
    at = np.unique(np.concatenate([along, np.arange(0.0, along[-1], _STEP_M)]))
    return np.column_stack([np.interp(at, along, points_m[:, axis]) for axis in (0, 1)])


def _wrap(angle_rad: float) -> float:
    return float((angle_rad + pi) % (2 * pi) - pi)
