"""Calibration of the whole committee by leaving out one scan at a time.

The mapper keeps a few scans. Each is taken out of the evidence again, the experts near some of its
beams are trained without it, and the committee is asked what those beams saw: the very question
that the next scan will ask. Leaving out single observations would be cheaper, but neighbouring
beams of one scan give each other's answers away, and the map would think too well of itself where
few scans were there (measured in docs/accuracy.md).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gpom_core.committee import OF_HITS, OF_INFORMATION, OF_PASSES, OF_PRECISION, SUMS
from gpom_core.config import MapConfig
from gpom_core.evidence import Evidence
from gpom_core.jit import compiled
from gpom_core.link import Link, fit, take_logarithms
from gpom_core.member import Member, train_member
from gpom_core.observations import LEAST_COUNT, Observations
from gpom_core.rows import BOX, SEGMENT
from gpom_core.scan import Scan
from gpom_core.snapshot import Snapshot

SCANS = 40
"""A mapper keeps as many. With 64 likelihood gains a percent, for 1.6 x the time."""

BEAMS = 40  # of a scan that are asked for; next to each other they would tell much less
_MARGIN_M = 0.2  # before a hit nothing is called free
_SHORTEST_M = 0.3
_NEGLIGIBLE = 0.05  # share of an observation: an expert that loses less than that everywhere stays
_SEED = 20220918

_Floats = NDArray[np.float64]
LeftOut = tuple[_Floats, NDArray[np.bool_]]


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationJob:
    """A version of the map and scans that are in it; `run` is pure and may run in any thread."""

    snapshot: Snapshot
    scans: tuple[Scan, ...]
    config: MapConfig
    trained: int = 0  # observations, since the calibration before
    telling: int = 0  # scans that brought something new, ever

    def run(self) -> Link:
        """The link of highest likelihood on what left-out scans saw.

        Raises:
            TrainingError: an expert cannot be trained without a scan.
        """
        return next(link for link in self.steps() if link is not None)

    def steps(self) -> Iterator[Link | None]:
        """The same in short steps: None after each scan, the link at last."""
        prior = self.snapshot.prior_variance
        seen: list[LeftOut] = [(np.empty((0, SUMS)), np.empty(0, np.bool_))]
        for part in leave_scans_out(self.snapshot, self.scans, self.config):
            seen.append(part)
            yield None
        sums, occupied = (np.concatenate(column) for column in zip(*seen, strict=True))
        take_logarithms(sums)
        left = 1.0 / (1.0 + prior * sums[:, OF_PRECISION])
        mean = sums[:, OF_INFORMATION] * left * prior
        yield fit(mean, left, sums[:, OF_HITS], sums[:, OF_PASSES], occupied)


def leave_scans_out(
    snapshot: Snapshot, scans: Sequence[Scan], config: MapConfig
) -> Iterator[LeftOut]:
    """The committee's sums (n, 4) and the truth (n,) at hits and free places of left-out scans.

    Free places lie at a uniform share of each beam, up to 0.2 m before its hit. The draw is
    seeded: the same map gives the same calibration.

    Args:
        scans: all of them in the snapshot.
    """
    rng = np.random.default_rng(_SEED)
    index = _Index(snapshot, config)
    for scan in scans:
        points, occupied = _questions(scan, config, rng)
        if len(points) > 0:
            yield index.without(scan, points).sums(points), occupied


def _questions(
    scan: Scan, config: MapConfig, rng: np.random.Generator
) -> tuple[_Floats, NDArray[np.bool_]]:
    """Hits, and a free place on each beam, of some beams; metres."""
    ranges = scan.ranges_m.astype(np.float64)
    beams = np.flatnonzero(scan.hits() & (ranges <= config.max_range_m))
    if len(beams) > BEAMS:
        beams = np.sort(rng.choice(beams, BEAMS, replace=False))
    angle = scan.beam_angles_rad()[beams]
    direction = np.column_stack([np.cos(angle), np.sin(angle)])
    long = ranges[beams] > _SHORTEST_M
    free = rng.random(len(beams)) * (ranges[beams] - _MARGIN_M)
    distance = np.concatenate([ranges[beams], free[long]])
    direction = np.concatenate([direction, direction[long]])
    points = np.array([scan.pose.x_m, scan.pose.y_m]) + distance[:, None] * direction
    return points, np.arange(len(points)) < len(beams)


class _Index:
    """Finds the observations, among those of all experts, that a scan is part of."""

    def __init__(self, snapshot: Snapshot, config: MapConfig) -> None:
        self._snapshot, self._config = snapshot, config
        self._nobody = snapshot.emptied()
        seen = {c: m.expert.observations for c, m in sorted(snapshot.members.items())}
        ends = np.cumsum([0, *(len(o) for o in seen.values())]).tolist()
        self._mine = {c: slice(*part) for c, part in zip(seen, pairwise(ends), strict=True)}
        self._begins = np.array(ends[:-1], np.int64)
        self._clusters = np.array(list(seen), np.int64)
        kinds = np.concatenate([np.empty(0, np.uint8), *(o.kinds for o in seen.values())])
        geometry = np.concatenate([np.empty((0, 2, 2)), *(o.geometry for o in seen.values())])
        self._count = np.concatenate([np.empty(0), *(o.count for o in seen.values())])
        key = _places_of(kinds, geometry, config, 0)
        self._order = np.argsort(key, kind="stable")
        self._key = key[self._order]

    def without(self, scan: Scan, points: _Floats) -> Snapshot:
        """The experts near points (n, 2), and no others, trained without a scan."""
        lost = self._shares(scan)
        loses = np.logical_or.reduceat(lost > _NEGLIGIBLE * self._count, self._begins)
        changed = set(self._clusters[loses].tolist())
        members = []
        for cluster in sorted(self._snapshot.near(points)):
            member = self._snapshot.members[cluster]
            if cluster in changed:
                rest = self._remaining(member.expert.observations, lost[self._mine[cluster]])
                if len(rest) == 0:
                    continue
                member = self._trained(member, rest)
            members.append(member)
        return self._nobody.swapped(members)

    def _shares(self, scan: Scan) -> _Floats:
        """How much of each observation's count, of all experts, is the scan's."""
        alone = Evidence(self._config.model_copy(update={"coarse_levels": 0}))
        alone.add(scan)
        n = alone.observation_count
        kind, geometry, count = (
            alone.rows.kind[:n], alone.rows.geometry[:n], alone.rows.count[:n],
        )  # fmt: skip
        lost = np.zeros(len(self._order))
        waiting = np.arange(n)
        for level in range(self._config.coarse_levels + 1):
            key = _places_of(kind[waiting], geometry[waiting], self._config, level)
            at = np.minimum(np.searchsorted(self._key, key), max(len(self._key) - 1, 0))
            found = self._key[at] == key if len(self._key) else np.zeros(len(key), np.bool_)
            np.add.at(lost, self._order[at[found]], count[waiting[found]])
            waiting = waiting[~found]
            waiting = waiting[kind[waiting] == BOX]  # only free areas are merged into coarser ones
        return lost

    def _remaining(self, seen: Observations, lost: _Floats) -> Observations:
        c = self._config
        left = seen.count - lost
        kept = left > LEAST_COUNT
        raw = np.where(seen.targets > 0.0, c.hit_noise_std, c.free_noise_std) ** 2
        # A count beyond its cap weighs no more, and what is lost of it no less.
        weight = np.minimum(raw / seen.noise_variance, np.maximum(left, LEAST_COUNT))
        return Observations(
            kinds=seen.kinds[kept],
            geometry=seen.geometry[kept],
            targets=seen.targets[kept],
            noise_variance=(raw / weight)[kept],
            count=left[kept],
        )

    @staticmethod
    def _trained(member: Member, rest: Observations) -> Member:
        return train_member(
            member.cluster_id, member.revision + 1, rest, member.expert.hyperparameters,
            member.line, has_its_noise=True,
        )  # fmt: skip


def _places_of(
    kinds: NDArray[np.uint8], geometry: _Floats, config: MapConfig, level: int
) -> NDArray[np.uint64]:
    """Keys (n,) of the places that observations merge in; free areas as part of coarser ones.

    Args:
        geometry: (n, 2, 2). level: areas of `cell_m` count as those of `cell_m * 2^level`.
    """
    return _places(
        kinds, geometry, config.cell_m, config.hit_cell_m, 0.5 * config.segment_m,
        config.coarse_levels, level,
    )  # fmt: skip


@compiled
def _places(
    kinds: NDArray[np.uint8],
    geometry: _Floats,
    cell_m: float,
    hit_cell_m: float,
    half_segment_m: float,
    coarse_levels: int,
    level: int,
) -> NDArray[np.uint64]:
    keys = np.empty(len(kinds), np.uint64)
    for i in range(len(kinds)):
        at = geometry[i]
        if kinds[i] == BOX:
            own = _level(at, cell_m, coarse_levels) + level
            # The middle of an area's first cell is in its cell, whatever the rounding.
            first = _cell(at[0], 0.5 * cell_m, cell_m * 2.0**own)
            second = _mixed(own, own)
        else:
            edge_m = half_segment_m if kinds[i] == SEGMENT else hit_cell_m
            first, second = _cell(at[0], 0.0, edge_m), _cell(at[1], 0.0, edge_m)
        # A segment has no direction.
        keys[i] = _mixed(_mixed(min(first, second), max(first, second)), kinds[i])
    return keys


@compiled
def _cell(point: _Floats, shift_m: float, edge_m: float) -> np.uint64:
    """Key of the cell that holds a point (2,) after it was shifted."""
    return _mixed(
        np.int64(np.floor((point[0] + shift_m) / edge_m)),
        np.int64(np.floor((point[1] + shift_m) / edge_m)),
    )


@compiled
def _level(box: _Floats, cell_m: float, coarse_levels: int) -> int:
    """Of the lattice's smallest cell that holds an area (2, 2)."""
    own = 0
    for _ in range(coarse_levels):
        for axis in range(2):
            low = np.int64(np.rint(box[0, axis] / cell_m))
            high = np.int64(np.rint(box[1, axis] / cell_m)) - 1
            if low >> own != high >> own:
                own += 1
                break
    return own


@compiled
def _mixed(a: int | np.integer, b: int | np.integer) -> np.uint64:
    """One number of two, so that few pairs share one; after Vigna's splitmix64."""
    z = np.uint64(a) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(b)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))
