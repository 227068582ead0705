"""What the map service answers, as frozen values."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class MapPrediction:
    """What the map says about N points, all from one version of it.

    Attributes:
        map_version: that answered.
        occupancy: (N,) probability of being occupied; 0.5 in unknown space.
        mean: (N,) of the latent process, -1 empty to +1 occupied.
        variance: (N,) of the latent process; the prior's in unknown space.
        known: (N,) whether the variance is clearly below the prior's.
    """

    map_version: int
    occupancy: NDArray[np.float64]
    mean: NDArray[np.float64]
    variance: NDArray[np.float64]
    known: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class PointPrediction:
    """What the map says about one point; fields as in `MapPrediction`."""

    map_version: int
    occupancy: float
    mean: float
    variance: float
    known: bool


@dataclass(frozen=True, slots=True)
class RobotStatus:
    """One robot as the map service sees it.

    Attributes:
        id: its name.
        scans: received.
        lost: scans missing from its sequence.
        last_seen: when its last scan came, as the service writes it.
        pose: x, y in m and yaw in rad of its last scan; None before the first.
        alive: whether its liveliness token is there.
        details: the whole answer, with what newer services add.
    """

    id: str
    scans: int
    lost: int
    last_seen: str | float | None
    pose: tuple[float, ...] | None
    alive: bool
    details: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class MapStatus:
    """How far the map is.

    Attributes:
        map_version: grows whenever trained experts are swapped in.
        scans_received: by the service.
        scans_integrated: into the evidence of the map.
        experts: in the committee.
        dirty_experts: whose evidence has changed since they were trained.
        observations: merged evidence that the experts hold.
        robots: all that were ever seen.
        bounds: xmin, ymin, xmax, ymax of the evidence in m; None while the map is empty.
        details: the whole answer, with what newer services add.
    """

    map_version: int
    scans_received: int
    scans_integrated: int
    experts: int
    dirty_experts: int
    observations: int
    robots: tuple[RobotStatus, ...]
    bounds: tuple[float, float, float, float] | None
    details: Mapping[str, Any]


def to_status(answer: Mapping[str, Any]) -> MapStatus:
    """Read the JSON of `GET /v1/status`.

    Raises:
        KeyError: a field is missing.
        TypeError: a field is of another kind.
        ValueError: likewise.
    """
    return MapStatus(
        map_version=int(answer["map_version"]),
        scans_received=int(answer["scans_received"]),
        scans_integrated=int(answer["scans_integrated"]),
        experts=int(answer["experts"]),
        dirty_experts=int(answer["dirty_experts"]),
        observations=int(answer["observations"]),
        robots=tuple(map(_to_robot, answer["robots"])),
        bounds=_to_box(answer["bounds"]),
        details=answer,
    )


def _to_robot(answer: Mapping[str, Any]) -> RobotStatus:
    pose = answer["pose"]
    return RobotStatus(
        id=str(answer["id"]),
        scans=int(answer["scans"]),
        lost=int(answer["lost"]),
        last_seen=answer["last_seen"],
        pose=None if pose is None else tuple(map(float, pose)),
        alive=bool(answer["alive"]),
        details=answer,
    )


def _to_box(values: Any) -> tuple[float, float, float, float] | None:
    if values is None:
        return None
    xmin, ymin, xmax, ymax = map(float, values)
    return xmin, ymin, xmax, ymax
