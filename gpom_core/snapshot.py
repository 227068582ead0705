"""An immutable version of the map: what queries read while the next version is being trained."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpom_core.committee import Fusion, prior_precision
from gpom_core.errors import InvalidQueryError
from gpom_core.extent import in_main_places
from gpom_core.field import Field
from gpom_core.link import Link
from gpom_core.member import CUTOFF_SCALES, SECTOR_M, Bounds, Member, sector_key
from gpom_core.reach import TILE_BITS, TILE_OFFSET
from gpom_core.sector import Sector, build_sector, committee_sums, few_sums

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
        changed_bounds: the area that differs from the version before, None if nothing does.
    """

    version: int = 0
    prior_variance: float = 1.0
    known_variance_ratio: float = 0.8
    link: Link = field(default_factory=Link)
    members: Mapping[int, Member] = field(default_factory=dict)
    sectors: Mapping[int, Sector] = field(default_factory=dict)
    changed_bounds: Bounds | None = None

    @cached_property
    def bounds(self) -> Bounds | None:
        """xmin, ymin, xmax, ymax of all evidence, metres; None while there is none."""
        return union(member.bounds for member in self.members.values())

    @cached_property
    def main_members(self) -> tuple[Member, ...]:
        """Those that are not in specks of evidence far from all others."""
        members = tuple(self.members.values())
        weights = [len(member.expert.observations) for member in members]
        main = in_main_places([member.bounds for member in members], weights)
        return tuple(member for member, is_main in zip(members, main, strict=True) if is_main)

    @cached_property
    def extent(self) -> Bounds | None:
        """As `bounds`, without specks far away: what to draw when nobody says what to draw."""
        return union(member.bounds for member in self.main_members)

    @cached_property
    def main_reach(self) -> Bounds | None:
        """As `extent`, grown by how far evidence has a say."""
        return union(_reach(member) for member in self.main_members)

    @cached_property
    def reach(self) -> Bounds | None:
        """As `bounds`, grown by how far evidence has a say; beyond, all is unknown."""
        return union(_reach(member) for member in self.members.values())

    @cached_property
    def _covered(self) -> Bounds | None:
        """Around all sectors: it holds `reach`, and takes no look at every expert to find."""
        if not self.sectors:
            return None
        keys = np.fromiter(self.sectors, np.int64, len(self.sectors))
        x = (keys >> TILE_BITS) - TILE_OFFSET
        y = (keys & ((1 << TILE_BITS) - 1)) - TILE_OFFSET
        low, high = (x.min(), y.min()), (x.max() + 1, y.max() + 1)
        xmin, ymin, xmax, ymax = (float(index) * SECTOR_M for index in (*low, *high))
        return xmin, ymin, xmax, ymax

    @cached_property
    def _fields(self) -> dict[Fusion, Field]:
        return {}

    def field(self, fusion: Fusion = Fusion.BCM) -> Field | None:
        """The field that `method="field"` reads, None while there is no evidence."""
        if self._covered is None:
            return None
        if fusion not in self._fields:
            self._fields[fusion] = Field(
                self.sectors, self._covered, fusion,
                negligible=NEGLIGIBLE, prior_variance=self.prior_variance,
                weights=self.link.weights,
            )  # fmt: skip
        return self._fields[fusion]

    def sums(
        self,
        points: NDArray[np.float64],
        fusion: Fusion = Fusion.BCM,
        method: Method = Method.EXACT,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The committee's precision and information at points (n, 2); the prior is included."""
        prior = prior_precision(fusion, self.prior_variance, len(self.members))
        if method is Method.FIELD and (field := self.field(fusion)) is not None:
            precision, information = field.sums(points)
            precision += prior
            return precision, information
        precision = np.full(len(points), prior)
        information = np.zeros(len(points))
        for key, which in _by_sector(points, self._covered).items():
            sector = self.sectors.get(key)
            if sector is not None:
                add = few_sums if len(which) <= FEW_POINTS else committee_sums
                add(
                    points, which, sector.corner, sector.tables, sector.scales,
                    sector.starts, sector.entries, int(fusion), NEGLIGIBLE,
                    precision, information,
                )  # fmt: skip
        return precision, information

    def query(self, points: ArrayLike, fusion: str = "bcm", method: str = "exact") -> Prediction:
        """Occupancy, mean and variance at points (n, 2) in metres.

        Args:
            fusion: a `Fusion` in lower case. method: a `Method` in lower case.

        Raises:
            InvalidQueryError: wrong shape, non-finite points, an unknown fusion rule or method.
        """
        precision, information = self.sums(
            as_points(points), Fusion.named(fusion), Method.named(method)
        )
        mean, variance = information / precision, 1.0 / precision
        return Prediction(
            occupancy=self.link.probability(mean, variance, self.prior_variance),
            mean=mean,
            variance=variance,
            known=variance < self.known_variance_ratio * self.prior_variance,
        )

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
        for key, which in _by_sector(points, self.reach).items():
            sector = self.sectors.get(key)
            if sector is not None:
                numbers = np.array(list(sector.members))
                found.update(numbers[sector.experts_near(points[which])].tolist())
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

    def swapped(self, new: Iterable[Member], gone: Iterable[int] = ()) -> Snapshot:
        """The next version: `new` experts in place of their old selves, `gone` ones left out."""
        members, sectors = dict(self.members), dict(self.sectors)
        touched: dict[int, dict[int, Member]] = {}
        areas: list[Bounds] = []
        tiles: list[NDArray[np.int64]] = []

        def content(member: Member) -> Iterator[dict[int, Member]]:
            areas.append(_reach(member))
            tiles.append(member.tiles)
            for key in member.sectors:
                if key not in touched:
                    touched[key] = dict(sectors[key].members) if key in sectors else {}
                yield touched[key]

        replaced = list(new)
        for cluster in [*gone, *(m.cluster_id for m in replaced)]:
            old = members.pop(cluster, None)
            if old is not None:
                for inside in content(old):
                    inside.pop(cluster, None)
        for member in replaced:
            members[member.cluster_id] = member
            for inside in content(member):
                inside[member.cluster_id] = member
        changed = np.concatenate(tiles) if tiles else None
        self._rebuild(sectors, touched, changed)
        return Snapshot(
            version=self.version + 1,
            prior_variance=self.prior_variance,
            known_variance_ratio=self.known_variance_ratio,
            link=self.link,
            members=members,
            sectors=sectors,
            changed_bounds=union(areas),
        )

    @staticmethod
    def _rebuild(
        sectors: dict[int, Sector],
        touched: Mapping[int, Mapping[int, Member]],
        changed: NDArray[np.int64] | None,
    ) -> None:
        for key, inside in touched.items():
            if inside:
                sectors[key] = build_sector(inside, key, sectors.get(key), changed)
            else:
                sectors.pop(key, None)


def grid_shape(bbox: Bounds, resolution_m: float) -> tuple[int, int]:
    """Rows and columns of a raster over `bbox`.

    Raises:
        InvalidQueryError: as `Snapshot.grid`.
    """
    if (
        np.shape(bbox) != (4,)
        or not np.isfinite(bbox).all()
        or bbox[0] >= bbox[2]
        or bbox[1] >= bbox[3]
    ):
        raise InvalidQueryError(
            f"bbox {tuple(bbox)} must be xmin, ymin, xmax, ymax in metres with min < max"
        )
    if not (np.isfinite(resolution_m) and resolution_m > 0.0):
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


def _reach(member: Member) -> Bounds:
    margin = float(np.sqrt(-2.0 * np.log(NEGLIGIBLE)) / member.scales[0])
    xmin, ymin, xmax, ymax = member.bounds
    return xmin - margin, ymin - margin, xmax + margin, ymax + margin


def _by_sector(points: NDArray[np.float64], area: Bounds | None) -> dict[int, NDArray[np.int64]]:
    """Numbers of the points in each sector; points outside the area are left out."""
    if area is None or len(points) == 0:
        return {}
    near = np.flatnonzero(((points >= area[:2]) & (points <= area[2:])).all(axis=1))
    if len(near) == 0:
        return {}
    index = np.floor(points[near] / SECTOR_M).astype(np.int64)
    keys = sector_key(index[:, 0], index[:, 1])
    order = np.argsort(keys, kind="stable")
    cuts = np.flatnonzero(np.diff(keys[order])) + 1
    return {int(keys[part[0]]): near[part] for part in np.split(order, cuts)}
