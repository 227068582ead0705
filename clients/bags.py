"""ROS bags as logs of scans: laser scans, and where the laser was from the transforms beside them.

Topics and frames are found where there is no choice, and asked for where there is one.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from rosbags.interfaces import Connection

from clients.bag_content import TF_TYPES, Bag, open_bag
from clients.errors import LogReadError
from clients.log_reader import LogSummary, NoReturns, ReadOptions
from gpom_core.errors import InvalidScanError, InvalidTransformError, UnknownPoseError
from gpom_core.frames import FrameTree
from gpom_core.ros import cdr
from gpom_core.ros.messages import frame_name, sweep_of, transforms_of
from gpom_core.scan import Scan
from gpom_core.sweep import Sweep, to_scan, to_still_scan

_MAP_FRAME = "map"
_NANOSECONDS = 1e9


class BagLog:
    """The scans of one topic of a bag, read as a whole when the object is made.

    Scans whose place is not known are skipped and counted per reason in `describe().skipped`.
    Motion during a sweep is corrected when the sensor reports its time from beam to beam.

    Args:
        path: of a ROS 1 bag, an MCAP or sqlite3 file, or the folder of a ROS 2 bag.
        options: what becomes of no-returns and long ranges; which topic, which frame is the map.

    Raises:
        LogReadError: missing, damaged, of other content, or a choice has to be made.
    """

    def __init__(self, path: Path, options: ReadOptions | None = None) -> None:
        self._options = options or ReadOptions()
        self._skipped: Counter[str] = Counter()
        self._no_returns = self._beams = 0
        with open_bag(Path(path)) as bag:
            self._kind = bag.kind
            topic = _choose_topic(bag, self._options.topic)
            tree = self._read_frames(bag, topic)
            sweeps = [
                sweep_of(message)
                for name, message in bag.messages(bag.topics(cdr.LASER_SCAN))
                if name == topic
            ]
        frame = sweeps[0].frame
        map_frame = _choose_map(path, tree, frame, self._options.map_frame)
        self.scans = self._place(sweeps, tree, map_frame)
        if not self.scans:
            raise LogReadError(_nowhere(path, self._skipped, topic, frame, map_frame))
        self._notes: tuple[str, ...] = (
            f"scans of {topic}, placed by where {frame} is in {map_frame}",
        )
        if map_frame != _MAP_FRAME:
            self._notes += (f"no frame is called {_MAP_FRAME}; {map_frame} may drift",)

    def __iter__(self) -> Iterator[Scan]:
        return iter(self.scans)

    def __len__(self) -> int:
        return len(self.scans)

    def describe(self) -> LogSummary:
        """Say what is in the bag."""
        places = np.array([scan.pose[:2] for scan in self.scans])
        low, high = places.min(axis=0), places.max(axis=0)
        stamps_ns = [scan.stamp_ns for scan in self.scans]
        return LogSummary(
            format=self._kind,
            scans=len(self.scans),
            beams=max(scan.ranges_m.size for scan in self.scans),
            duration_s=(max(stamps_ns) - min(stamps_ns)) / _NANOSECONDS,
            bounds_m=(float(low[0]), float(low[1]), float(high[0]), float(high[1])),
            range_ceiling_m=self._options.range_ceiling_m,
            no_return_share=self._no_returns / max(self._beams, 1),
            skipped=dict(self._skipped),
            notes=self._notes,
        )

    def _read_frames(self, bag: Bag, topic: str) -> FrameTree:
        tree = FrameTree(keep_s=None)
        topics = _of_the_same_robot(bag.topics(*TF_TYPES), topic)
        if not topics:
            message = (
                f"{bag.path} has scans ({topic}) but no transforms (/tf), so where the laser was "
                "is not known; record /tf and /tf_static too, with a frame such as map from "
                "SLAM or localisation"
            )
            raise LogReadError(message)
        for name, message in bag.messages(topics):
            fixed = name.endswith("tf_static")
            try:
                for item in transforms_of(message):
                    tree.add(item.parent, item.child, item.pose, None if fixed else item.stamp_ns)
            except InvalidTransformError:
                self._skipped["invalid transform"] += 1
        return tree

    def _place(self, sweeps: list[Sweep], tree: FrameTree, map_frame: str) -> list[Scan]:
        scans = []
        for sweep in sweeps:
            try:
                scans.append(self._believed(_placed(sweep, tree, map_frame)))
            except UnknownPoseError as error:
                self._skipped[_REASONS[error.reason]] += 1
            except InvalidScanError as error:
                self._skipped[error.reason] += 1
        return scans

    def _believed(self, scan: Scan) -> Scan:
        """Apply the options to the ranges."""
        options = self._options
        ranges_m = scan.ranges_m.copy()
        sight_m = min(options.range_cap_m or np.inf, scan.range_max_m)
        ceiling_m = options.range_ceiling_m or np.inf
        # A reading beyond what the sensor itself calls its maximum stays invalid.
        nothing = np.isposinf(ranges_m) | ((ranges_m > sight_m) & scan.hits())
        nothing |= np.isfinite(ranges_m) & (ranges_m >= ceiling_m)
        self._beams += ranges_m.size
        self._no_returns += int(np.count_nonzero(nothing))
        ranges_m[nothing] = np.inf if options.no_returns is NoReturns.FREE else np.nan
        return replace(scan, ranges_m=ranges_m, range_max_m=float(min(sight_m, ceiling_m)))


_REASONS = {
    "unconnected": "frames not connected",
    "too_new": "after the last transform",
    "too_old": "before the first transform",
}


def _placed(sweep: Sweep, tree: FrameTree, map_frame: str) -> Scan:
    first = tree.lookup(map_frame, sweep.frame, sweep.stamp_ns)
    if sweep.last_stamp_ns == sweep.stamp_ns:
        return to_scan(sweep, first)
    try:
        last = tree.lookup(map_frame, sweep.frame, sweep.last_stamp_ns)
    except UnknownPoseError:  # the recording ends within the sweep
        return to_scan(sweep, first)
    return to_still_scan(sweep, first, last)


def _choose_topic(bag: Bag, wanted: str | None) -> str:
    counts: Counter[str] = Counter()
    for connection in bag.topics(cdr.LASER_SCAN):
        counts[connection.topic] += connection.msgcount
    if not counts:
        message = f"{bag.path} has no laser scans ({cdr.LASER_SCAN}); it holds: {bag.content()}"
        raise LogReadError(message)
    found = ", ".join(f"{topic} ({count})" for topic, count in sorted(counts.items()))
    if wanted is None:
        if len(counts) > 1:
            message = f"{bag.path} has scans on several topics: {found}; choose one with --topic"
            raise LogReadError(message)
        return next(iter(counts))
    for name in (wanted, f"/{wanted}"):
        if name in counts:
            return name
    raise LogReadError(f"{bag.path} has no laser scans on {wanted}; it has them on: {found}")


def _of_the_same_robot(transforms: list[Connection], topic: str) -> list[Connection]:
    """Leave out transforms of other robots, if each has a namespace: frames have equal names."""
    near = [
        connection
        for connection in transforms
        if topic.startswith(connection.topic.rpartition("/")[0] + "/")
    ]
    return near or transforms


def _choose_map(path: Path, tree: FrameTree, frame: str, wanted: str | None) -> str:
    """Give the frame to place scans in: as asked, or `map`, or what everything else hangs on."""
    parents = tree.frames()
    known = {*parents, *parents.values()}
    if wanted is not None:
        name = frame_name(wanted)
        if name not in known:
            message = f"{path} has no frame {name}; it has: {', '.join(sorted(known))}"
            raise LogReadError(message)
        return name
    if frame not in known:
        message = (
            f"{path} has scans in the frame {frame}, which no transform leads to; its frames are: "
            f"{', '.join(sorted(known))}"
        )
        raise LogReadError(message)
    if _MAP_FRAME in known:
        return _MAP_FRAME
    root = frame
    passed: set[str] = set()
    while root in parents and root not in passed:
        passed.add(root)
        root = parents[root]
    return root


def _nowhere(path: Path, skipped: Counter[str], topic: str, frame: str, map_frame: str) -> str:
    reasons = ", ".join(f"{count} {reason}" for reason, count in skipped.most_common(5))
    return (
        f"none of the scans of {topic} in {path} can be placed: where {frame} is in {map_frame} is "
        f"not known at their times ({reasons})"
    )
