"""Occupancy grids to compare against: a counting grid and a clamped log-odds grid.

Both walk every beam exactly through the cells (Amanatides & Woo, "A Fast Voxel Traversal
Algorithm for Ray Tracing", 1987) and count a cell at most once per scan, a hit beating a miss,
as OctoMap's insertPointCloud does (Hornung et al. 2013). Cells are ``floor(x / resolution)``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from copy import copy
from dataclasses import dataclass
from math import log
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from gpom_core.errors import ConfigurationError, InvalidQueryError
from gpom_core.jit import compiled
from gpom_core.metrics import negative_log_likelihood

RESOLUTIONS_M = (0.05, 0.1, 0.2)
MAX_CELLS = 1 << 28

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]


@compiled
def _cells_of_scan(
    stamp: NDArray[np.int32],
    cols: int,
    number: int,
    origin: Floats,
    ends: Floats,
    start: Indices,
    last: Indices,
) -> tuple[Indices, Indices]:
    """Flat indices of the cells that one scan hits and misses, each at most once.

    Args:
        stamp: (rows * cols,) number of the last scan that touched each cell; updated.
        cols: cells in a row.
        number: this scan.
        origin: (2,) sensor, in cells. ends: (n, 2) hits, in cells.
        start: (2,) cell of the sensor. last: (n, 2) cells of the hits.
    """
    hits = np.empty(len(last), np.int64)
    n_hits = 0
    n_steps = 0
    for k in range(len(last)):
        n_steps += abs(last[k, 0] - start[0]) + abs(last[k, 1] - start[1])
        cell = last[k, 1] * cols + last[k, 0]
        if stamp[cell] != number:
            stamp[cell] = number
            hits[n_hits] = cell
            n_hits += 1
    misses = np.empty(n_steps, np.int64)
    n_misses = 0
    x0, y0 = origin[0], origin[1]
    for k in range(len(last)):
        i, j = start[0], start[1]
        dx, dy = ends[k, 0] - x0, ends[k, 1] - y0
        sign_x = 1 if last[k, 0] >= i else -1
        sign_y = 1 if last[k, 1] >= j else -1
        # parameter along the beam at the next vertical and horizontal cell border
        delta_x = 1.0 / abs(dx) if dx != 0.0 else np.inf
        delta_y = 1.0 / abs(dy) if dy != 0.0 else np.inf
        next_x = (i + 1 - x0 if sign_x > 0 else x0 - i) * delta_x if dx != 0.0 else np.inf
        next_y = (j + 1 - y0 if sign_y > 0 else y0 - j) * delta_y if dy != 0.0 else np.inf
        # counting the steps, not comparing with 1, ends in the right cell whatever the rounding
        steps_x, steps_y = abs(last[k, 0] - i), abs(last[k, 1] - j)
        while steps_x + steps_y > 0:
            cell = j * cols + i
            if stamp[cell] != number:
                stamp[cell] = number
                misses[n_misses] = cell
                n_misses += 1
            if steps_y == 0 or (steps_x > 0 and next_x < next_y):
                i += sign_x
                next_x += delta_x
                steps_x -= 1
            else:
                j += sign_y
                next_y += delta_y
                steps_y -= 1
    return hits[:n_hits], misses[:n_misses]


class _Raster:
    """Dense layers of cells that grow with what they have to hold."""

    def __init__(self, layers: int) -> None:
        self.corner = np.zeros(2, np.int64)  # cell index (x, y) of values[:, 0, 0]
        self.values = np.zeros((layers, 0, 0), np.float32)
        self.stamp = np.zeros((0, 0), np.int32)

    def cover(self, low: Indices, high: Indices) -> None:
        """Make room for the cells low..high (inclusive), with a margin so growth is rare."""
        shape = np.array(self.stamp.shape[::-1])
        if shape.any():
            if np.all(low >= self.corner) and np.all(high < self.corner + shape):
                return
            low = np.minimum(low, self.corner)
            high = np.maximum(high, self.corner + shape - 1)
        margin = (high - low) // 4 + 1
        corner, size = low - margin, high - low + 1 + 2 * margin
        if float(size[0]) * float(size[1]) > MAX_CELLS:
            raise ConfigurationError(
                f"the scans span {size[0]} x {size[1]} cells, more than {MAX_CELLS}: "
                "use a coarser resolution"
            )
        values = np.zeros((len(self.values), size[1], size[0]), np.float32)
        stamp = np.zeros((size[1], size[0]), np.int32)
        dx, dy = self.corner - corner if shape.any() else (0, 0)
        old = np.s_[dy : dy + shape[1], dx : dx + shape[0]]
        values[:, old[0], old[1]] = self.values
        stamp[old] = self.stamp
        self.corner, self.values, self.stamp = corner, values, stamp

    def at(self, x: Indices, y: Indices) -> Floats:
        """(layers, N) values of cells, zero outside the raster."""
        i, j = x - self.corner[0], y - self.corner[1]
        rows, cols = self.stamp.shape
        inside = (i >= 0) & (i < cols) & (j >= 0) & (j < rows)
        found = np.zeros((len(self.values), len(i)))
        found[:, inside] = self.values[:, j[inside], i[inside]]
        return found


class OccupancyGrid(ABC):
    """A grid map that scans are added to and points are asked of. Not thread-safe."""

    def __init__(self, resolution_m: float, layers: int) -> None:
        """Start an empty grid.

        Args:
            resolution_m: side of a cell.
            layers: numbers kept per cell.

        Raises:
            ConfigurationError: the resolution is not a positive number.
        """
        if not (np.isfinite(resolution_m) and resolution_m > 0.0):
            raise ConfigurationError(f"resolution_m is {resolution_m}, expected more than 0")
        self.resolution_m = resolution_m
        self._raster = _Raster(layers)
        self._scans = 0

    def add(self, origin_m: Floats, hits_m: Floats) -> None:
        """Add one scan.

        Args:
            origin_m: (2,) sensor position in the map frame.
            hits_m: (n, 2) end points of the beams that returned.

        Raises:
            InvalidQueryError: a coordinate is not finite.
            ConfigurationError: the grid would grow beyond its limit of cells.
        """
        origin = np.asarray(origin_m, np.float64) / self.resolution_m
        ends = np.ascontiguousarray(hits_m, np.float64) / self.resolution_m
        if not (np.all(np.isfinite(ends)) and np.all(np.isfinite(origin))):
            raise InvalidQueryError("a scan's origin or end points are not finite")
        if len(ends) == 0:
            return
        start, last = np.floor(origin).astype(np.int64), np.floor(ends).astype(np.int64)
        raster = self._raster
        raster.cover(np.minimum(start, last.min(axis=0)), np.maximum(start, last.max(axis=0)))
        self._scans += 1
        hits, misses = _cells_of_scan(
            raster.stamp.reshape(-1),
            raster.stamp.shape[1],
            self._scans,
            origin - raster.corner,
            ends - raster.corner,
            start - raster.corner,
            last - raster.corner,
        )
        self._absorb(raster.values.reshape(len(raster.values), -1), hits, misses)

    @property
    def size_bytes(self) -> int:
        """Memory of the numbers in all cells, touched or not."""
        return self._raster.values.nbytes

    def seen_cells(self) -> Floats:
        """(M, 2) centres of all cells that any beam touched, metres."""
        rows, cols = np.nonzero(self._raster.stamp)
        cells = np.column_stack([cols, rows]) + self._raster.corner
        return (cells.astype(np.float64) + 0.5) * self.resolution_m

    @abstractmethod
    def occupancy(self, points: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Probability of occupancy at points.

        Args:
            points: (N, 2) in the map frame, metres.

        Returns:
            (N,) probabilities, 0.5 where nothing was seen, and (N,) whether something was.
        """

    @abstractmethod
    def _absorb(self, values: NDArray[np.float32], hits: Indices, misses: Indices) -> None:
        """Update the flat layers with the distinct cells that one scan hit and missed."""


@dataclass(frozen=True, slots=True)
class CountingModel:
    """Weights of a counting grid.

    Attributes:
        hit_weight: misses that one hit outweighs. Beams graze the cells of a wall on their way to
            its next cells, so a hit says more than a miss.
        prior_count: weight of the prior, one half.
    """

    hit_weight: float = 20.0
    prior_count: float = 0.05


COUNTING_MODELS = tuple(
    CountingModel(w, q) for w in (10.0, 20.0, 40.0, 80.0) for q in (0.05, 0.1, 0.2, 0.4)
)
"""What a tuned counting grid chooses from, on training data."""


class CountingGrid(OccupancyGrid):
    """h hits and m misses per cell, p = (w h + q)/(w h + m + 2 q), h and m blended bilinearly."""

    def __init__(self, resolution_m: float, model: CountingModel | None = None) -> None:
        """Start an empty grid with cells of resolution_m."""
        super().__init__(resolution_m, layers=2)
        self.model = model or CountingModel()

    def with_model(self, model: CountingModel) -> CountingGrid:
        """The same counts (shared, not copied) read with other weights."""
        other = copy(self)
        other.model = model
        return other

    def counts(self, points: Floats) -> tuple[Floats, Floats]:
        """(N,) hits and (N,) misses at (N, 2) points, bilinear between cell centres."""
        at = np.asarray(points, np.float64) / self.resolution_m - 0.5
        low = np.floor(at)
        fx, fy = (at - low).T
        i, j = low.astype(np.int64).T
        cell = self._raster.at
        lower = (1.0 - fx) * cell(i, j) + fx * cell(i + 1, j)
        upper = (1.0 - fx) * cell(i, j + 1) + fx * cell(i + 1, j + 1)
        hits, misses = (1.0 - fy) * lower + fy * upper
        return hits, misses

    def occupancy(self, points: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Probability from the four nearest cells; see OccupancyGrid.occupancy."""
        hits, misses = self.counts(points)
        weighed, prior = self.model.hit_weight * hits, self.model.prior_count
        return (weighed + prior) / (weighed + misses + 2.0 * prior), hits + misses > 0.0

    def _absorb(self, values: NDArray[np.float32], hits: Indices, misses: Indices) -> None:
        values[0, hits] += 1.0
        values[1, misses] += 1.0


@dataclass(frozen=True, slots=True)
class LogOddsModel:
    """Sensor model of a log-odds grid as probabilities; the defaults are OctoMap's."""

    hit: float = 0.7
    miss: float = 0.4
    low: float = 0.12
    high: float = 0.97


class LogOddsGrid(OccupancyGrid):
    """Clamped log-odds per cell, as OctoMap in its default settings on one plane."""

    def __init__(self, resolution_m: float, model: LogOddsModel | None = None) -> None:
        """Start an empty grid with cells of resolution_m."""
        super().__init__(resolution_m, layers=2)
        self.model = model or LogOddsModel()

    def occupancy(self, points: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Probability of the cell that holds the point; see OccupancyGrid.occupancy."""
        i, j = np.floor(np.asarray(points, np.float64) / self.resolution_m).astype(np.int64).T
        log_odds, seen = self._raster.at(i, j)
        return 1.0 / (1.0 + np.exp(-log_odds)), seen > 0.0

    def _absorb(self, values: NDArray[np.float32], hits: Indices, misses: Indices) -> None:
        low, high = _log_odds(self.model.low), _log_odds(self.model.high)
        values[0, hits] = np.minimum(values[0, hits] + _log_odds(self.model.hit), high)
        values[0, misses] = np.maximum(values[0, misses] + _log_odds(self.model.miss), low)
        values[1, hits] = 1.0
        values[1, misses] = 1.0


GridT = TypeVar("GridT", bound=OccupancyGrid)


def best_by_likelihood(
    grids: Iterable[GridT], points: Floats, occupied: NDArray[np.bool_]
) -> GridT:
    """The grid with the lowest negative log likelihood on points that none of them has seen.

    Give it points of training scans set aside, never of the held-out scans.

    Args:
        grids: candidates, at least one.
        points: (N, 2) in the map frame, metres.
        occupied: (N,) labels.
    """
    return min(grids, key=lambda g: negative_log_likelihood(g.occupancy(points)[0], occupied))


def _log_odds(probability: float) -> float:
    return log(probability / (1.0 - probability))
