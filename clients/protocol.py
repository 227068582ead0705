"""The evaluation protocol that every accuracy figure uses.

Scans whose index modulo 10 is 5 are held out, the rest build the map. No-returns are ignored and
longer ranges than 20 m are not believed. Test points are the held-out hits (occupied) and one free
point on each held-out beam; 10,000 of them are kept. Nothing may be fitted on held-out scans.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from math import isfinite, sqrt
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from clients.logs import NoReturns, ReadOptions, is_held_out, open_log
from gpom_core.baselines import CountingGrid
from gpom_core.errors import ConfigurationError
from gpom_core.metrics import Scores, score
from gpom_core.scan import Scan

RANGE_CAP_M = 20.0
KEPT_POINTS = 10_000
SHARES = (Fraction(1), Fraction(1, 3), Fraction(1, 10), Fraction(1, 30))
SHORTEST_FREE_BEAM_M = 0.3
HIT_MARGIN_M = 0.2
_FAR_CELL_M = 0.05

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Predict = Callable[[Floats], tuple[Floats, Bools]]
"""Points (N, 2) in the map frame to probabilities of occupancy (N,) and whether known (N,)."""


@dataclass(frozen=True, slots=True, eq=False)
class LabelledPoints:
    """Where a map is asked, and what is true there.

    Attributes:
        points: (N, 2) in the map frame, metres.
        occupied: (N,) True for a hit, False for a point that a beam passed.
    """

    points: Floats
    occupied: Bools

    def __len__(self) -> int:
        return len(self.occupied)

    def where(self, chosen: Bools | NDArray[np.int64]) -> "LabelledPoints":
        """Keep the points of a mask or an index."""
        return LabelledPoints(self.points[chosen], self.occupied[chosen])


def read_scans(path: Path, topic: str | None = None, map_frame: str | None = None) -> list[Scan]:
    """Read a log as the protocol wants it: capped, and no-returns ignored.

    Args:
        path: of a CARMEN log or a ROS bag.
        topic: of the scans, in a bag that has several.
        map_frame: in which scans are placed, in a bag.

    Raises:
        LogReadError: the file cannot be read as a log of laser scans.
    """
    options = ReadOptions(NoReturns.IGNORE, RANGE_CAP_M, None, topic, map_frame)
    return [capped(scan) for scan in open_log(path, options)]


def capped(scan: Scan, range_cap_m: float = RANGE_CAP_M) -> Scan:
    """Give the scan without what the protocol ignores: no-returns and ranges beyond the cap."""
    believed = scan.hits() & (scan.ranges_m <= range_cap_m)
    return replace(scan, ranges_m=np.where(believed, scan.ranges_m, np.float32(np.nan)))


def split(scans: Sequence[Scan]) -> tuple[list[Scan], list[Scan]]:
    """Divide the scans of a log, in order of recording, into training and held-out scans."""
    training = [scan for index, scan in enumerate(scans) if not is_held_out(index)]
    held_out = [scan for index, scan in enumerate(scans) if is_held_out(index)]
    return training, held_out


def parse_share(text: str) -> Fraction:
    """Read a share of the training scans such as ``1``, ``1/3`` or ``0.1``.

    Raises:
        ConfigurationError: the text is not one over a whole number.
    """
    try:
        share = Fraction(text).limit_denominator(1_000_000)
    except (ValueError, ZeroDivisionError):
        share = Fraction(0)
    if share.numerator != 1:
        raise ConfigurationError(
            f"share is {text!r}; expected one over a whole number: 1, 1/3, 1/10, 1/30 …"
        )
    return share


def thin(scans: Sequence[Scan], share: Fraction | float) -> list[Scan]:
    """Keep every k-th scan, the first among them, for a share of 1/k.

    Raises:
        ConfigurationError: the share is not in (0, 1].
    """
    if not (isfinite(share) and 0.0 < share <= 1.0):
        raise ConfigurationError(f"share is {share}; expected more than 0 and at most 1")
    return list(scans[:: round(1 / share)])


def hit_ends(scan: Scan) -> Floats:
    """Compute the end points of the beams that returned, (n, 2) in the map frame, metres."""
    returned = scan.hits()
    return _along(scan, returned, scan.ranges_m[returned].astype(np.float64))


def labelled_points(
    scans: Sequence[Scan], seed: int, keep: int | None = KEPT_POINTS
) -> LabelledPoints:
    """Draw test points from scans: all hits, and a free point on each beam longer than 0.3 m.

    A free point lies at a uniform fraction of (range - 0.2 m).

    Args:
        scans: capped scans that took no part in building the map.
        seed: of the fractions and of the choice of points to keep.
        keep: number of points to choose; None for all.
    """
    rng = np.random.default_rng(seed)
    hits, free = [np.empty((0, 2))], [np.empty((0, 2))]
    for scan in scans:
        hits.append(hit_ends(scan))
        ranges_m = scan.ranges_m.astype(np.float64)
        passed = scan.hits() & (ranges_m > SHORTEST_FREE_BEAM_M)
        reach_m = ranges_m[passed] - HIT_MARGIN_M
        free.append(_along(scan, passed, rng.random(reach_m.size) * reach_m))
    points = np.concatenate(hits + free)
    occupied = np.arange(len(points)) < sum(map(len, hits))
    chosen = np.sort(rng.permutation(len(points))[:keep])
    return LabelledPoints(points, occupied).where(chosen)


def lacking(test: LabelledPoints) -> str | None:
    """What test points do not have of what they need, for people; None for nothing."""
    if len(test) == 0:
        return f"no hit: all beams are no-returns, invalid or longer than {RANGE_CAP_M:g} m"
    if test.occupied.all():
        return f"no passing beam: all hits are nearer than {SHORTEST_FREE_BEAM_M:g} m"
    return None if test.occupied.any() else "no hit"


def held_out_points(
    scans: Sequence[Scan], seed: int, keep: int | None = KEPT_POINTS, log: str = "the log"
) -> LabelledPoints:
    """Draw the test points of a log from its held-out scans: hits, and points that beams passed.

    Args:
        scans: all scans of the log, in order.
        log: its name, for the error.

    Raises:
        ConfigurationError: no scan is held out, or those that are lack hits or passing beams.
    """
    _, held_out = split(scans)
    if not held_out:
        raise ConfigurationError(
            f"{log} has {len(scans)} scans; expected six scans or more, since scans 5, 15, 25 … "
            "are held out to test the map"
        )
    test = labelled_points(held_out, seed, keep)
    if missing := lacking(test):
        raise ConfigurationError(
            f"{log} cannot test a map: its held-out scans (5, 15, 25 …) have {missing}"
        )
    return test


def far_from_beams(points: Floats, training: Sequence[Scan], distance_m: float) -> Bools:
    """Which points (N, 2) are farther than `distance_m` from every training beam.

    Beams are taken as the 5 cm cells they cross, so the distance is right to 7 cm and never
    overestimated: what is called far is far.

    Raises:
        ConfigurationError: the distance is not a positive number.
    """
    if not (isfinite(distance_m) and distance_m > 0.0):
        raise ConfigurationError(f"the distance is {distance_m} m; expected more than 0")
    grid = CountingGrid(_FAR_CELL_M)
    for scan in training:
        grid.add(np.array(scan.pose[:2]), hit_ends(scan))
    cells = grid.seen_cells()
    if len(cells) == 0:
        return np.ones(len(points), np.bool_)
    margin_m = _FAR_CELL_M / sqrt(2.0)
    reach_m = distance_m + margin_m
    nearest_m, _ = cKDTree(cells).query(points, distance_upper_bound=reach_m)
    return np.asarray(nearest_m > reach_m, np.bool_)


def evaluate(predict: Predict, points: Floats, occupied: Bools) -> Scores:
    """Score a map at labelled points; `Scores.share_unknown` is what it calls unknown.

    Args:
        predict: the map.
        points: (N, 2) in the map frame, metres.
        occupied: (N,) labels, of both kinds.
    """
    probability, known = predict(points)
    return score(probability, occupied, known)


def _along(scan: Scan, beams: Bools, distance_m: Floats) -> Floats:
    angle = scan.beam_angles_rad()[beams]
    step = np.column_stack([np.cos(angle), np.sin(angle)])
    ends: Floats = np.array([scan.pose.x_m, scan.pose.y_m]) + distance_m[:, None] * step
    return ends
