"""The geometry of simulated sites: solid boxes in the plane, and exact questions about them."""

from dataclasses import dataclass
from math import isfinite
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpom_core.errors import ConfigurationError, InvalidQueryError
from gpom_core.jit import compiled

Floats = NDArray[np.float64]

# Instead of a zero component of a direction: far beyond any site, never 0/0.
_TINY = 1e-12


class Box(NamedTuple):
    """A solid rectangle.

    Attributes:
        x_m: of its centre.
        y_m: of its centre.
        width_m: along its own first axis.
        depth_m: along its own second axis.
        yaw_rad: of its first axis.
    """

    x_m: float
    y_m: float
    width_m: float
    depth_m: float
    yaw_rad: float = 0.0


@dataclass(frozen=True, slots=True, eq=False, init=False)
class World:
    """Solid boxes in otherwise empty space: the ground truth of a simulation.

    Args:
        boxes: at least one, of positive size; they may overlap.

    Raises:
        ConfigurationError: no boxes, or one that is none.
    """

    boxes: tuple[Box, ...]
    _centres: Floats
    _halves: Floats
    _axes: Floats  # (S, 2, 2): rows are the unit vectors of each box

    def __init__(self, boxes: "list[Box] | tuple[Box, ...]") -> None:
        for box in boxes:
            if not all(map(isfinite, box)) or min(box.width_m, box.depth_m) <= 0.0:
                message = f"{box} is no box; expected finite numbers and a positive size"
                raise ConfigurationError(message)
        if not boxes:
            message = "a world needs at least one box"
            raise ConfigurationError(message)
        table = np.array(boxes, dtype=np.float64)
        cos, sin = np.cos(table[:, 4]), np.sin(table[:, 4])
        put = object.__setattr__  # the dataclass is frozen
        put(self, "boxes", tuple(boxes))
        put(self, "_centres", table[:, :2])
        put(self, "_halves", table[:, 2:4] / 2)
        put(self, "_axes", np.stack([np.stack([cos, sin], 1), np.stack([-sin, cos], 1)], 1))

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """xmin, ymin, xmax, ymax of all boxes."""
        corners = self.segments()[:, 0]
        (xmin, ymin), (xmax, ymax) = corners.min(axis=0), corners.max(axis=0)
        return float(xmin), float(ymin), float(xmax), float(ymax)

    def segments(self) -> Floats:
        """Give the surfaces: (4 S, 2, 2), four sides of S boxes, each from end to end, in m."""
        signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]], dtype=np.float64)
        own = signs * self._halves[:, None, :]
        corners = self._centres[:, None, :] + own @ self._axes
        sides = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2)
        return sides.reshape(-1, 2, 2)

    def distance(self, points: ArrayLike) -> Floats:
        """Give the distance of points (N, 2) to the nearest surface, negative inside a box, in m.

        Raises:
            InvalidQueryError: the points have another shape.
        """
        where = np.asarray(points, dtype=np.float64)
        if where.ndim != 2 or where.shape[1] != 2:
            message = f"points have shape {where.shape}; expected (N, 2), x and y in m"
            raise InvalidQueryError(message)
        nearest = np.full(len(where), np.inf)
        for centre, half, axes in zip(self._centres, self._halves, self._axes, strict=True):
            beyond = np.abs((where - centre) @ axes.T) - half
            outside = np.hypot(*np.maximum(beyond, 0.0).T)
            np.minimum(nearest, outside + np.minimum(beyond.max(axis=1), 0.0), out=nearest)
        return nearest

    def is_occupied(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Whether points (N, 2) lie in or on a box."""
        return self.distance(points) <= 0.0

    def cast(self, origin: ArrayLike, angles_rad: ArrayLike) -> Floats:
        """Give the way from `origin` to the first surface along each direction.

        Boxes are slabs: a beam is inside one where it is inside both of its pairs of parallel
        lines.

        Args:
            origin: x, y in m.
            angles_rad: (n,) in the map frame.

        Returns:
            (n,) in m; inf where nothing is hit, 0 inside a box.
        """
        angles = np.ascontiguousarray(angles_rad, dtype=np.float64)
        start = np.asarray(origin, dtype=np.float64)
        return _first_surfaces(start, angles, self._centres, self._halves, self._axes)


@compiled
def _first_surfaces(
    origin: Floats, angles: Floats, centres: Floats, halves: Floats, axes: Floats
) -> Floats:
    """`World.cast`, box by box: (n,) for n angles."""
    found = np.full(len(angles), np.inf)
    cos, sin = np.cos(angles), np.sin(angles)
    for box in range(len(centres)):
        x, y = origin[0] - centres[box, 0], origin[1] - centres[box, 1]
        at = axes[box, 0, 0] * x + axes[box, 0, 1] * y, axes[box, 1, 0] * x + axes[box, 1, 1] * y
        for beam in range(len(angles)):
            enters, leaves = 0.0, np.inf
            for axis in range(2):
                slope = axes[box, axis, 0] * cos[beam] + axes[box, axis, 1] * sin[beam]
                if abs(slope) < _TINY:
                    slope = _TINY
                one = (-halves[box, axis] - at[axis]) / slope
                other = (halves[box, axis] - at[axis]) / slope
                enters = max(enters, min(one, other))
                leaves = min(leaves, max(one, other))
            if enters <= leaves:
                found[beam] = min(found[beam], enters)
    return found
