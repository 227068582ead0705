"""The geometry of simulated sites: solid boxes in the plane, and exact questions about them."""

from dataclasses import dataclass
from math import isfinite
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpom_core.errors import ConfigurationError, InvalidQueryError

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

        All beams meet all boxes at once, as slabs: a beam is inside a box where it is inside both
        of its pairs of parallel lines.

        Args:
            origin: x, y in m.
            angles_rad: (n,) in the map frame.

        Returns:
            (n,) in m; inf where nothing is hit, 0 inside a box.
        """
        start = np.einsum(
            "sij,sj->si", self._axes, np.asarray(origin, dtype=np.float64) - self._centres
        )
        directions = np.stack([np.cos(angles_rad), np.sin(angles_rad)])
        slopes = self._axes @ directions  # (S, 2, n)
        slopes = np.where(np.abs(slopes) < _TINY, _TINY, slopes)
        near = (-self._halves - start)[:, :, None] / slopes
        far = (self._halves - start)[:, :, None] / slopes
        enters = np.minimum(near, far).max(axis=1)
        leaves = np.maximum(near, far).min(axis=1)
        hit = leaves >= np.maximum(enters, 0.0)
        distances: Floats = np.where(hit, np.maximum(enters, 0.0), np.inf).min(axis=0)
        return distances
