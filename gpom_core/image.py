"""The whole state of a mapper as plain arrays, and back: what checkpoints and map files hold.

Experts are kept by what they were trained on and with; loading trains them again, which is cheap,
exact, and ten times smaller than their inverse matrices. Loading trusts nothing: compiled loops
do not check their indices, so every index, size and number is checked here first.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gpom_core import clusters as cluster_room
from gpom_core import rows as row_room
from gpom_core import tiles as tile_room
from gpom_core.clusters import Clusters
from gpom_core.config import MapConfig
from gpom_core.errors import GpomError, InvalidScanError
from gpom_core.expert import Hyperparameters
from gpom_core.link import Link
from gpom_core.mapper import Mapper, TrainedExpert
from gpom_core.member import train_member
from gpom_core.observations import Observations
from gpom_core.recalibration import SCANS
from gpom_core.rows import COORDINATE_LIMIT, NONE, Rows
from gpom_core.scan import Pose2D, Scan
from gpom_core.snapshot import Snapshot
from gpom_core.tiles import Tiles

VERSION = 4
"""Of the set of arrays; a higher one is refused."""

LENGTH_SCALES_MAX = 50.0  # times the configured one: an expert's index grows with its square
OBSERVATIONS_MAX = 20_000  # of one expert: its matrix grows with the square

Image = Mapping[str, NDArray[np.generic]]

_ANY = -1
_SHAPES: dict[str, tuple[str, tuple[int, ...]]] = {
    "version": ("int64", ()),
    "counters": ("int64", (6,)),  # scans, those that told, now and then; the others of `dump`
    "link": ("float64", (6,)),
    "kept_frame": ("float64", (_ANY, 7)),  # pose, first angle, increment, range limits
    "kept_ranges": ("float32", (_ANY,)),
    "kept_start": ("int64", (_ANY,)),
    "gone": ("int64", (_ANY,)),
    "row_keys": ("int64", (_ANY, 2)),
    "row_kind": ("uint8", (_ANY,)),
    "row_geometry": ("float64", (_ANY, 2, 2)),
    "row_count": ("float64", (_ANY,)),
    "row_learned": ("float64", (_ANY,)),
    "row_crossed": ("uint8", (_ANY,)),
    "row_near": ("float64", (_ANY,)),
    "row_owner": ("int32", (_ANY,)),
    "row_order": ("int64", (_ANY,)),
    "tile_keys": ("int64", (_ANY,)),
    "tile_free": ("int32", (_ANY, 64)),
    "tile_hit": ("int32", (_ANY, 64)),
    "tile_first": ("int32", (_ANY,)),
    "tile_whole": ("int32", (_ANY,)),
    "whole_passed": ("float64", (_ANY, 64)),  # of the tiles that are one free area, in order
    "cluster_origin": ("float64", (_ANY, 2)),
    "cluster_moments": ("float64", (_ANY, 6)),
    "cluster_gain": ("float64", (_ANY,)),
    "cluster_fresh": ("int32", (_ANY,)),
    "cluster_revision": ("int64", (_ANY,)),
    "expert_cluster": ("int64", (_ANY,)),
    "expert_revision": ("int64", (_ANY,)),
    "expert_hyperparameters": ("float64", (_ANY, 4)),
    "expert_line": ("float64", (_ANY, 2, 2)),
    "expert_start": ("int64", (_ANY,)),
    "seen_kind": ("uint8", (_ANY,)),
    "seen_geometry": ("float64", (_ANY, 2, 2)),
    "seen_target": ("float64", (_ANY,)),
    "seen_noise": ("float64", (_ANY,)),
    "seen_count": ("float64", (_ANY,)),
}
NAMES = frozenset(_SHAPES)
"""Of the arrays of an image."""


class InvalidImageError(GpomError):
    """The arrays are not the state of a mapper of this version and configuration."""


def dump(mapper: Mapper) -> dict[str, NDArray[np.generic]]:
    """Copy the state of a mapper; experts in training are dirty in the copy.

    Call it in the thread that owns the mapper; the copy may go anywhere.
    """
    evidence = mapper._evidence
    rows, tiles, clusters = evidence.rows, evidence.tiles, evidence.clusters
    r, t, c = int(rows.size[0]), int(tiles.size[0]), int(clusters.size[0])
    fresh = clusters.fresh[:c].copy()
    for cluster in mapper._training:
        fresh[cluster] = max(fresh[cluster], 1)
    snapshot = mapper.snapshot()
    counters = (
        mapper.scan_count, mapper._telling, mapper._telling_then,
        mapper._calibrated, mapper._uncalibrated, snapshot.version,
    )  # fmt: skip
    return {
        "version": np.array(VERSION, np.int64),
        "counters": np.array(counters, np.int64),
        "link": np.array(snapshot.link.weights),
        **_dump_scans(mapper.kept_scans),
        "gone": np.array(sorted(mapper._gone), np.int64),
        "row_keys": rows.keys[:r].copy(),
        "row_kind": rows.kind[:r].copy(),
        "row_geometry": rows.geometry[:r].copy(),
        "row_count": rows.count[:r].copy(),
        "row_learned": rows.learned[:r].copy(),
        "row_crossed": rows.crossed[:r].copy(),
        "row_near": rows.near[:r].copy(),
        "row_owner": rows.owner[:r].copy(),
        "row_order": _order(rows, clusters),
        "tile_keys": tiles.keys[:t, 0].copy(),
        "tile_free": tiles.free[:t].copy(),
        "tile_hit": tiles.hit[:t].copy(),
        "tile_first": tiles.first[:t].copy(),
        "tile_whole": tiles.whole[:t].copy(),
        "whole_passed": tiles.passed[:t][tiles.whole[:t] != NONE],
        "cluster_origin": clusters.origin[:c].copy(),
        "cluster_moments": clusters.moments[:c].copy(),
        "cluster_gain": clusters.gain[:c].copy(),
        "cluster_fresh": fresh,
        "cluster_revision": clusters.revision[:c].copy(),
        **_dump_experts(snapshot),
    }


def load(image: Image, config: MapConfig, executor: Executor | None = None) -> Mapper:
    """The mapper whose state was dumped: it goes on, and answers, as that one would.

    Args:
        config: that of the dumped mapper; with another one evidence would not fit its lattice.
        executor: trains the experts; this thread if not given.

    Raises:
        InvalidImageError: an array is missing, of another shape, or holds what cannot be.
        TrainingError: an expert cannot be trained.
    """
    arrays = _checked(image)
    mapper = Mapper(config)
    evidence = mapper._evidence
    evidence.rows = _load_rows(arrays, config)
    evidence.tiles = _load_tiles(arrays, config)
    evidence.clusters = _load_clusters(arrays, evidence.rows)
    (
        mapper._scans, mapper._telling, mapper._telling_then, mapper._calibrated,
        mapper._uncalibrated, version,
    ) = (int(value) for value in arrays["counters"])  # fmt: skip
    mapper._kept = _load_scans(arrays)
    mapper._gone = set(arrays["gone"].tolist())
    empty = replace(mapper.snapshot(), link=_load_link(arrays))
    members = _load_experts(arrays, config, executor)
    mapper._snapshot = replace(empty.swapped(members), version=version)
    return mapper


def _order(rows: Rows, clusters: Clusters) -> NDArray[np.int64]:
    """Rows in the order of their clusters' lists: splitting walks along them."""
    out = np.empty(int(clusters.rows[: int(clusters.size[0])].sum()), np.int64)
    n = 0
    after = rows.after[: int(rows.size[0])].tolist()
    for head in clusters.head[: int(clusters.size[0])].tolist():
        row = head
        while row != NONE:
            out[n] = row
            n += 1
            row = after[row]
    return out


def _dump_scans(scans: Sequence[Scan]) -> dict[str, NDArray[np.generic]]:
    """What calibration needs of a scan."""
    frames = [
        (*s.pose, s.angle_min_rad, s.angle_increment_rad, s.range_min_m, s.range_max_m)
        for s in scans
    ]
    ranges = [np.empty(0, np.float32), *(s.ranges_m for s in scans)]
    return {
        "kept_frame": np.array(frames, np.float64).reshape(-1, 7),
        "kept_ranges": np.concatenate(ranges),
        "kept_start": np.cumsum([0, *(len(s.ranges_m) for s in scans)], dtype=np.int64),
    }


def _load_scans(arrays: Image) -> list[Scan]:
    frames, ranges = arrays["kept_frame"].tolist(), arrays["kept_ranges"]
    start = arrays["kept_start"].tolist()
    whole = len(start) == len(frames) + 1 and start[0] == 0 and start[-1] == len(ranges)
    _require(whole and sorted(start) == start and len(frames) <= SCANS, "kept_start does not fit")
    try:
        return [
            Scan(Pose2D(x, y, yaw), np.asarray(ranges[first:end], np.float32), *rest)
            for (x, y, yaw, *rest), (first, end) in zip(frames, pairwise(start), strict=True)
        ]
    except InvalidScanError as error:
        raise InvalidImageError(f"this is not the state of a map: a kept scan: {error}") from None


def _load_link(arrays: Image) -> Link:
    try:
        return Link(tuple(arrays["link"].tolist()))
    except ValueError as error:
        raise InvalidImageError(f"this is not the state of a map: {error}") from None


def _dump_experts(snapshot: Snapshot) -> dict[str, NDArray[np.generic]]:
    members = [member for _, member in sorted(snapshot.members.items())]
    seen = [member.expert.observations for member in members]
    chosen = [member.expert.hyperparameters for member in members]

    def joined(name: str, shape: tuple[int, ...], dtype: str) -> NDArray[np.generic]:
        return np.concatenate([np.empty(shape, dtype), *(getattr(one, name) for one in seen)])

    return {
        "expert_cluster": np.array([member.cluster_id for member in members], np.int64),
        "expert_revision": np.array([member.revision for member in members], np.int64),
        "expert_hyperparameters": np.array(
            [
                (h.length_scale_m, h.signal_std, h.hit_noise_scale, h.free_noise_scale)
                for h in chosen
            ]
        ).reshape(-1, 4),
        "expert_line": np.array([member.line for member in members]).reshape(-1, 2, 2),
        "expert_start": np.cumsum([0, *(len(one) for one in seen)], dtype=np.int64),
        "seen_kind": joined("kinds", (0,), "uint8"),
        "seen_geometry": joined("geometry", (0, 2, 2), "float64"),
        "seen_target": joined("targets", (0,), "float64"),
        "seen_noise": joined("noise_variance", (0,), "float64"),
        "seen_count": joined("count", (0,), "float64"),
    }


def _checked(image: Image) -> dict[str, NDArray[np.generic]]:
    if "version" in image and image["version"].shape == ():
        version = int(image["version"])
        if version != VERSION:
            message = f"the state is of version {version}; this gpom reads {VERSION}: use another"
            raise InvalidImageError(message)
    _require(set(image) == NAMES, f"arrays {sorted(set(image) ^ NAMES)} are missing or unknown")
    for name, (dtype, shape) in _SHAPES.items():
        array = image[name]
        fits = array.ndim == len(shape) and all(
            wanted in (_ANY, actual) for wanted, actual in zip(shape, array.shape, strict=True)
        )
        _require(
            fits and array.dtype == np.dtype(dtype),
            f"{name} is {array.dtype} {array.shape}; expected {dtype} {shape}",
        )
        if dtype == "float64" and name != "row_near":
            _require(bool(np.isfinite(array).all()), f"{name} holds NaN or infinity")
    for first, *others in _SAME_LENGTH:
        for other in others:
            same = len(image[first]) == len(image[other])
            _require(same, f"{first} and {other} differ in length")
    return dict(image)


_SAME_LENGTH = (
    [name for name in _SHAPES if name.startswith("row_") and name != "row_order"],
    [name for name in _SHAPES if name.startswith("tile_")],
    [name for name in _SHAPES if name.startswith("cluster_")],
    ["expert_cluster", "expert_revision", "expert_hyperparameters", "expert_line"],
    [name for name in _SHAPES if name.startswith("seen_")],
)


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise InvalidImageError(f"this is not the state of a map: {message}")


def _within(array: NDArray[np.generic], low: int, end: int, name: str) -> None:
    inside = len(array) == 0 or (int(array.min()) >= low and int(array.max()) < end)
    _require(inside, f"{name} points outside")


def _places(geometry: NDArray[np.generic], config: MapConfig, name: str) -> None:
    values = geometry.astype(np.float64)
    limit = COORDINATE_LIMIT * config.hit_cell_m
    _require(bool((np.abs(values) <= limit).all()), f"{name} lies outside the lattice")
    longest = 2.0 * max(config.cell_m * 2**config.coarse_levels, config.segment_m)
    extent = np.abs(values[:, 1] - values[:, 0])
    _require(bool((extent <= longest).all()), f"{name} holds an observation too long")


def _fill(target: object, source: Image, prefix: str, names: tuple[str, ...], used: int) -> None:
    for name in names:
        getattr(target, name)[:used] = source[f"{prefix}_{name}"]


def _load_rows(arrays: Image, config: MapConfig) -> Rows:
    used = len(arrays["row_kind"])
    _require(used < 2**31, "too many rows")
    _within(arrays["row_kind"], 0, 3, "row_kind")
    _within(arrays["row_owner"], NONE, len(arrays["cluster_gain"]), "row_owner")
    _places(arrays["row_geometry"], config, "row_geometry")
    _require(bool((arrays["row_count"] >= 0).all()), "row_count is negative")  # type: ignore[operator]
    rows = row_room.new_rows(max(4096, used))
    names = ("keys", "kind", "geometry", "count", "learned", "crossed", "near", "owner")
    _fill(rows, arrays, "row", names, used)
    rows.size[0] = used
    row_room._index(rows, used)
    return rows


def _load_tiles(arrays: Image, config: MapConfig) -> Tiles:
    used, rows = len(arrays["tile_keys"]), len(arrays["row_kind"])
    for name in ("tile_free", "tile_hit", "tile_first", "tile_whole"):
        _within(arrays[name].ravel(), NONE, rows, name)
    keys = np.zeros((used, 2), np.int64)
    keys[:, 0] = arrays["tile_keys"]
    _require(len(np.unique(keys[:, 0])) == used, "tile_keys repeats")
    tiles = tile_room.new_tiles(max(256, used))
    _fill(tiles, arrays, "tile", ("free", "hit", "first", "whole"), used)
    whole = np.flatnonzero(tiles.whole[:used] != NONE)
    passed = np.asarray(arrays["whole_passed"], np.float64)
    _require(len(passed) == len(whole) and bool((passed >= 0.0).all()), "whole_passed")
    areas = tiles.whole[whole]
    crossed = np.count_nonzero(passed, axis=1)
    owned = (arrays["row_owner"][areas] != NONE) & (crossed > 0)
    fits = owned & (arrays["row_crossed"][areas] == crossed)
    _require(bool(fits.all()) and len(np.unique(areas)) == len(areas), "tile_whole does not fit")
    tiles.passed[whole] = passed
    for kind, held in enumerate((tiles.free, tiles.hit)):
        tiles.used[:used, kind] = np.count_nonzero(held[:used] != NONE, axis=1)
    free = tiles.free[:used]
    near = np.minimum(np.asarray(arrays["row_near"], np.float64), config.near_surface_m)
    tiles.around[:used][free != NONE] = near[free[free != NONE]] ** 2
    tile_room._index(tiles, keys)
    return tiles


def _load_clusters(arrays: Image, rows: Rows) -> Clusters:
    used = len(arrays["cluster_gain"])
    clusters = cluster_room.new_clusters(max(256, used))
    _fill(clusters, arrays, "cluster", ("origin", "moments", "gain", "fresh", "revision"), used)
    clusters.size[0] = used
    order = np.asarray(arrays["row_order"], np.int64)
    _within(order, 0, int(rows.size[0]), "row_order")
    owned = np.flatnonzero(rows.owner[: int(rows.size[0])] != NONE)
    _require(bool(np.array_equal(np.sort(order), owned)), "row_order is no order of the rows")
    row_room.relink(rows, clusters.head, clusters.rows, order)
    return clusters


def _load_experts(
    arrays: Image, config: MapConfig, executor: Executor | None
) -> list[TrainedExpert]:
    start = np.asarray(arrays["expert_start"], np.int64)
    sizes = np.diff(start)
    whole = len(start) == len(arrays["expert_cluster"]) + 1 and start[0] == 0
    _require(whole and start[-1] == len(arrays["seen_kind"]), "expert_start does not fit")
    _require(bool(((sizes > 0) & (sizes <= OBSERVATIONS_MAX)).all()), "an expert's size")
    _within(arrays["expert_cluster"], 0, len(arrays["cluster_gain"]), "expert_cluster")
    _within(arrays["gone"], 0, len(arrays["cluster_gain"]), "gone")
    distinct = len(np.unique(arrays["expert_cluster"])) == len(sizes)
    _require(distinct, "expert_cluster repeats")
    _within(arrays["seen_kind"], 0, 3, "seen_kind")
    _places(arrays["seen_geometry"], config, "seen_geometry")
    for name in ("seen_noise", "expert_hyperparameters"):
        _require(bool((arrays[name] > 0).all()), f"{name} is not positive")  # type: ignore[operator]
    scales = np.asarray(arrays["expert_hyperparameters"], np.float64)[:, 0]
    _require(
        bool((scales <= LENGTH_SCALES_MAX * config.length_scale_m).all()), "a length scale is long"
    )
    run = map if executor is None else executor.map
    return list(run(_trainer(arrays, start), range(len(sizes))))


def _trainer(arrays: Image, start: NDArray[np.int64]) -> Callable[[int], TrainedExpert]:
    def trained(i: int) -> TrainedExpert:
        part = slice(int(start[i]), int(start[i + 1]))
        observations = Observations(
            *(np.ascontiguousarray(arrays[f"seen_{name}"][part]) for name in _SEEN)  # type: ignore[arg-type]
        )
        chosen = Hyperparameters(*(float(h) for h in arrays["expert_hyperparameters"][i]))
        return train_member(
            int(arrays["expert_cluster"][i]),
            int(arrays["expert_revision"][i]),
            observations,
            chosen,
            np.asarray(arrays["expert_line"][i], np.float64),
            has_its_noise=True,  # it got it before it was dumped
        )

    return trained


_SEEN = ("kind", "geometry", "target", "noise", "count")
