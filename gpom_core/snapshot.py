"""An immutable version of the map: what queries read while the next version is being trained."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from math import floor

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpom_core import extent
from gpom_core.committee import (
    SUMS,
    Fusion,
    prior_precision,
)
from gpom_core.errors import InvalidQueryError
from gpom_core.field import Field
from gpom_core.link import Link, answers, take_logarithms
from gpom_core.member import (
    CUTOFF_SCALES,
    EXPERTS,
    REACH,
    SECTOR_M,
    Bounds,
    Member,
    sector_area,
    sector_key,
)
from gpom_core.sector import Sector, changed_sector, committee_sums, few_sums
from gpom_core.shared import Shared

NEGLIGIBLE = float(np.exp(-0.5 * CUTOFF_SCALES**2))  # of the signal variance
FEW_POINTS = 4  # in one sector; in 0.1 ms other threads get nothing done that is worth a switch
MAX_GRID_CELLS = 200_000_000


class Method(Enum):
    """How to evaluate the committee."""

    EXACT = "exact"
    FIELD = "field"
    """Between the nodes of a lattice that is filled where somebody asks: see `gpom_core.field`."""

    @classmethod
    def named(cls, name: str) -> Method:
        """The method called `name`.

        Raises:
            InvalidQueryError: there is no such method.
        """
        try:
            return cls(name)
        except ValueError:
            known = ", ".join(method.value for method in cls)
            message = f"method {name!r} is not known; use one of {known}"
            raise InvalidQueryError(message) from None


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """What the committee says at n points, (n,) each.

    Attributes:
        occupancy: probability of being occupied; 0.5 where nothing is known.
        mean, variance: of the latent function; 0 and the prior variance where nothing is known.
        known: the variance is clearly below the prior's.
    """

    occupancy: NDArray[np.float64]
    mean: NDArray[np.float64]
    variance: NDArray[np.float64]
    known: NDArray[np.bool_]

    def reshape(self, *shape: int) -> Prediction:
        """The same values in another shape."""
        return Prediction(
            self.occupancy.reshape(shape),
            self.mean.reshape(shape),
            self.variance.reshape(shape),
            self.known.reshape(shape),
        )


@dataclass(frozen=True, slots=True)
class ExpertSummary:
    """One expert as `/v1/experts` shows it; lengths in metres."""

    cluster_id: int
    line: tuple[tuple[float, float], tuple[float, float]]
    observations: int
    hits: int
    length_scale_m: float
    signal_std: float
    revision: int


def as_points(points: ArrayLike) -> NDArray[np.float64]:
    """`points` as a finite float64 array (n, 2).

    Raises:
        InvalidQueryError: another shape, not numbers, NaN or infinite.
    """
    try:
        array = np.asarray(points, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InvalidQueryError(f"points are not numbers: {error}") from None
    if array.ndim == 1 and array.size == 0:
        array = array.reshape(0, 2)
    if array.ndim != 2 or array.shape[1] != 2:
        raise InvalidQueryError(f"points have shape {array.shape}, expected (n, 2)")
    if not np.isfinite(array).all():
        raise InvalidQueryError("points hold NaN or infinity, expected finite metres")
    return np.ascontiguousarray(array)


@dataclass(frozen=True, eq=False)
class Snapshot:
    """One version of the map. Immutable; any number of threads may query it.

    Attributes:
        version: grows with every swap of experts.
        prior_variance: of the latent function in unknown space.
        members: cluster number to expert.
        sectors, blocks: see `gpom_core.sector` and `gpom_core.extent`; by their keys.
        covered: around all sectors there ever were, metres: it holds `reach`, and costs no look at
            any expert. None while there are none.
        changed_bounds: the area that differs from the version before, None if nothing does.
    """

    version: int = 0
    prior_variance: float = 1.0
    known_variance_ratio: float = 0.8
    link: Link = field(default_factory=Link)
    members: Shared[Member] = field(default_factory=Shared)
    sectors: Shared[Sector] = field(default_factory=Shared)
    blocks: extent.Blocks = field(default_factory=Shared)
    covered: Bounds | None = None
    changed_bounds: Bounds | None = None

    @cached_property
    def _everything(self) -> NDArray[np.float64]:
        return extent.total(block.total for block in self.blocks.values())

    @cached_property
    def _main(self) -> NDArray[np.float64]:
        """All but specks of evidence far from all others."""
        return extent.main_total(self.blocks)

    @property
    def bounds(self) -> Bounds | None:
        """xmin, ymin, xmax, ymax of all evidence, metres; None while there is none."""
        return extent.area_of(self._everything)

    @property
    def reach(self) -> Bounds | None:
        """As `bounds`, grown by how far evidence has a say; beyond, all is unknown."""
        return extent.area_of(self._everything, REACH)

    @property
    def extent(self) -> Bounds | None:
        """As `bounds`, without specks far away: what to draw when nobody says what to draw."""
        return extent.area_of(self._main)

    @property
    def main_reach(self) -> Bounds | None:
        """As `extent`, grown by how far evidence has a say."""
        return extent.area_of(self._main, REACH)

    @property
    def main_count(self) -> int:
        """How many experts are not in specks far away."""
        return int(self._main[EXPERTS])

    @cached_property
    def _fields(self) -> dict[Fusion, Field]:
        return {}

    def field(self, fusion: Fusion = Fusion.BCM) -> Field | None:
        """The field that `method="field"` reads, None while there is no evidence."""
        if self.covered is None:
            return None
        fields = self._fields
        if fusion not in fields:
            fields[fusion] = Field(
                self.sectors, self.covered, fusion,
                negligible=NEGLIGIBLE, prior_variance=self.prior_variance,
                weights=self.link.weights,
            )  # fmt: skip
        return fields[fusion]

    def sums(
        self,
        points: NDArray[np.float64],
        fusion: Fusion = Fusion.BCM,
    ) -> NDArray[np.float64]:
        """The committee's sums (n, 4) at points (n, 2), without the prior.

        Columns as in `gpom_core.committee`.
        """
        sums = np.zeros((len(points), SUMS))
        for key, which in _by_sector(points, self.covered).items():
            sector = self.sectors.get(key)
            if sector is not None:
                add = few_sums if len(which) <= FEW_POINTS else committee_sums
                add(
                    points, which, sector.corner, sector.tables,
                    sector.starts, sector.entries, int(fusion), NEGLIGIBLE, sums,
                )  # fmt: skip
        return sums

    def query(self, points: ArrayLike, fusion: str = "bcm", method: str = "exact") -> Prediction:
        """Occupancy, mean and variance at points (n, 2) in metres.

        Args:
            fusion: a `Fusion` in lower case. method: a `Method` in lower case.

        Raises:
            InvalidQueryError: wrong shape, non-finite points, an unknown fusion rule or method.
        """
        where, rule = as_points(points), Fusion.named(fusion)
        field = self.field(rule) if Method.named(method) is Method.FIELD else None
        if field is not None:
            sums = field.sums(where)
        else:
            sums = self.sums(where, rule)
            take_logarithms(sums)
        prior = prior_precision(int(rule), self.prior_variance, len(self.members))
        mean, variance, occupancy = answers(
            sums, prior, self.prior_variance, np.array(self.link.weights)
        )
        known = variance < self.known_variance_ratio * self.prior_variance
        return Prediction(occupancy, mean, variance, known)

    def grid(
        self, bbox: Bounds, resolution_m: float, fusion: str = "bcm", method: str = "exact"
    ) -> Prediction:
        """The map at the cell centres of a raster, (rows, columns), row 0 at ymin.

        Args:
            bbox: xmin, ymin, xmax, ymax, metres; a started cell counts as one.

        Raises:
            InvalidQueryError: an empty or non-finite box, a resolution of 0, too many cells.
        """
        rows, columns = grid_shape(bbox, resolution_m)
        x = bbox[0] + (np.arange(columns) + 0.5) * resolution_m
        y = bbox[1] + (np.arange(rows) + 0.5) * resolution_m
        points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        return self.query(points, fusion, method).reshape(rows, columns)

    def near(self, points: NDArray[np.float64]) -> set[int]:
        """Cluster numbers of the experts whose evidence may have a say at points (n, 2)."""
        found: set[int] = set()
        for key, which in _by_sector(points, self.covered).items():
            sector = self.sectors.get(key)
            if sector is not None:
                found.update(sector.experts_near(points[which]).tolist())
        return found

    def experts(self) -> list[ExpertSummary]:
        """All experts, by cluster number."""
        return [
            ExpertSummary(
                cluster_id=m.cluster_id,
                line=((m.line[0, 0], m.line[0, 1]), (m.line[1, 0], m.line[1, 1])),
                observations=len(m.expert.observations),
                hits=int(np.count_nonzero(m.expert.observations.targets > 0)),
                length_scale_m=m.expert.hyperparameters.length_scale_m,
                signal_std=m.expert.hyperparameters.signal_std,
                revision=m.revision,
            )
            for _, m in sorted(self.members.items())
        ]

    def with_link(self, link: Link) -> Snapshot:
        """This map with other probabilities; its version stays, so swap it in at once."""
        return replace(self, link=link, changed_bounds=self.reach)

    def emptied(self) -> Snapshot:
        """A map without experts that is to answer by the same rules."""
        return replace(
            self, members=Shared(), sectors=Shared(), blocks=Shared(), covered=None,
            changed_bounds=self.reach,
        )  # fmt: skip

    def swapped(self, new: Iterable[Member], gone: Iterable[int] = ()) -> Snapshot:
        """The next version: `new` experts in place of their old selves, `gone` ones left out."""
        fresh = {member.cluster_id: member for member in new}
        lost = [cluster for cluster in gone if cluster not in fresh]
        changes: dict[int, dict[int, Member | None]] = {}
        touched: list[Member] = []
        for cluster in (*lost, *fresh):
            old = self.members.get(cluster)
            if old is not None:
                touched.append(old)
                for key in old.sectors:
                    changes.setdefault(key, {})[cluster] = None
        for cluster, member in fresh.items():
            touched.append(member)
            for key in member.sectors:
                changes.setdefault(key, {})[cluster] = member
        tiles = np.concatenate([np.empty(0, np.int64), *(member.tiles for member in touched)])
        sectors = {
            key: changed_sector(key, self.sectors.get(key), inside, tiles)
            for key, inside in changes.items()
        }
        kept = {key: sector for key, sector in sectors.items() if sector is not None}
        parts = {key: None if one is None else one.part for key, one in sectors.items()}
        squares = [sector_area(key) for key in kept]
        later = replace(
            self,
            version=self.version + 1,
            members=self.members.updated(fresh, lost),
            sectors=self.sectors.updated(kept, sectors.keys() - kept.keys()),
            blocks=extent.updated(self.blocks, parts),
            covered=union([*squares, *([] if self.covered is None else [self.covered])]),
            changed_bounds=union(member.reach for member in touched),
        )
        if len(kept) == len(sectors) and later.covered is not None:
            later._fields.update({
                fusion: field.swapped(kept, later.covered)
                for fusion, field in list(self._fields.items())  # queries add to it
            })  # fmt: skip
        return later


def grid_shape(bbox: Bounds, resolution_m: float) -> tuple[int, int]:
    """Rows and columns of a raster over `bbox`.

    Raises:
        InvalidQueryError: as `Snapshot.grid`.
    """
    try:
        numbers = np.asarray((*bbox, resolution_m))
    except (TypeError, ValueError):
        numbers = np.empty(0, object)
    if numbers.dtype.kind not in "iuf":  # text that looks like a number is none
        message = f"bbox {bbox!r} and resolution {resolution_m!r} are not all numbers"
        raise InvalidQueryError(message)
    box, cell_m = numbers[:-1].astype(np.float64), float(numbers[-1])
    if box.shape != (4,) or not np.isfinite(box).all() or (box[:2] >= box[2:]).any():
        raise InvalidQueryError(
            f"bbox {bbox!r} must be xmin, ymin, xmax, ymax in metres with min < max"
        )
    if not (np.isfinite(cell_m) and cell_m > 0.0):
        raise InvalidQueryError(f"resolution {resolution_m} must be a positive number of metres")
    # A hair less than a cell is rounding, not another cell; far from the origin hairs are thicker.
    hair = min(1e-9 + 4.0 * float(np.spacing(np.abs(bbox).max())) / resolution_m, 0.1)
    columns = np.ceil((bbox[2] - bbox[0]) / resolution_m - hair)
    rows = np.ceil((bbox[3] - bbox[1]) / resolution_m - hair)
    if rows * columns > MAX_GRID_CELLS:
        raise InvalidQueryError(
            f"{rows * columns:.0f} cells are more than {MAX_GRID_CELLS}; ask for a smaller box or "
            "a coarser resolution"
        )
    return max(int(rows), 1), max(int(columns), 1)


def union(areas: Iterable[Bounds]) -> Bounds | None:
    """The smallest box around all boxes, None if there are none."""
    corners = np.array(list(areas))
    if len(corners) == 0:
        return None
    low, high = corners[:, :2].min(axis=0), corners[:, 2:].max(axis=0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def _by_sector(points: NDArray[np.float64], area: Bounds | None) -> dict[int, NDArray[np.int64]]:
    """Numbers of the points in each sector; points outside the area are left out."""
    if area is None or len(points) == 0:
        return {}
    if len(points) == 1:  # what planners ask all the time, without a sort
        x, y = points[0].tolist()
        if not (area[0] <= x <= area[2] and area[1] <= y <= area[3]):
            return {}
        return {sector_key(floor(x / SECTOR_M), floor(y / SECTOR_M)): np.zeros(1, np.int64)}
    near = np.flatnonzero(((points >= area[:2]) & (points <= area[2:])).all(axis=1))
    if len(near) == 0:
        return {}
    index = np.floor(points[near] / SECTOR_M).astype(np.int64)
    keys = sector_key(index[:, 0], index[:, 1])
    order = np.argsort(keys, kind="stable")
    cuts = np.flatnonzero(np.diff(keys[order])) + 1
    return {int(keys[part[0]]): near[part] for part in np.split(order, cuts)}
