"""What is wrong with a fleet, told from a few seconds of what its robots say."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from clients.fleet_frames import FleetFrames
from clients.listener import SCAN_TYPE, Heard, Way
from gpom_core import wire
from gpom_core.errors import GpomError
from gpom_core.ros import attachment, cdr
from gpom_core.ros.messages import pose_of, read_sweep
from gpom_core.wire import DEFAULT_MAX_BEAMS

CLOCK_OFF_S = 0.5
"""A scan that is older or younger than this when it comes was stamped by a clock that is off."""
SLOW_HZ = 1.0

_NANOSECONDS = 1e9
_KEPT_STAMPS = 2000
_DAY_S = 86_400.0


@dataclass(frozen=True, slots=True)
class StreamReport:
    """One stream of scans.

    Attributes:
        way: how it comes.
        topic: of the scans.
        scans: that came.
        rate_hz: of them.
        beams: of the last one.
        frame: of the last one; empty when scans bring their pose.
        lost: by gaps in their numbers; None when they have none.
        age_s: median of how old scans were when they came, by their own stamps.
        placed: share whose place in the map is known.
        problems: sentences, the worst first; empty when all is well.
        notes: what is no problem, but good to know.
    """

    way: Way
    topic: str
    scans: int
    rate_hz: float
    beams: int
    frame: str
    lost: int | None
    age_s: float
    placed: float
    problems: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(slots=True)
class _Stream:
    beams: int = 0
    frame: str = ""
    lost: int | None = None
    numbers: dict[bytes, int] = field(default_factory=dict)
    stamps_ns: list[int] = field(default_factory=list)
    frames: list[str] = field(default_factory=list)
    arrived_ns: list[int] = field(default_factory=list)
    broken: Counter[str] = field(default_factory=Counter)

    def count(self, publisher: bytes, number: int) -> None:
        last = self.numbers.get(publisher)
        gap = 0 if last is None else max(number - last - 1, 0)
        self.lost = (self.lost or 0) + gap
        self.numbers[publisher] = number

    def came(self, stamp_ns: int, arrived_ns: int) -> None:
        if len(self.stamps_ns) < _KEPT_STAMPS:
            self.stamps_ns.append(stamp_ns)
            self.frames.append(self.frame)
        self.arrived_ns.append(arrived_ns)


class Examination:
    """Listens to messages, then says what it found.

    Args:
        map_frame: that scans are to be placed in.
        pose_from: ``tf``, ``odometry`` or ``pose``, as the service is told.
        base_frame: whose pose a message tells that names no child frame.
    """

    def __init__(
        self, map_frame: str = "map", pose_from: str = "tf", base_frame: str = "base_link"
    ) -> None:
        self._pose_from = pose_from
        self._base_frame = base_frame
        self._streams: dict[tuple[Way, str], _Stream] = {}
        self._frames = FleetFrames(map_frame, from_tf=pose_from == "tf")
        self.troubles: Counter[str] = Counter()

    def hear(self, heard: Heard) -> None:
        """Take a message."""
        try:
            if heard.type_name == SCAN_TYPE:
                self._hear_native(heard)
            elif heard.type_name == cdr.LASER_SCAN:
                self._hear_scan(heard)
            elif heard.type_name == cdr.TF_MESSAGE:
                self._hear_transforms(heard)
            else:
                self._hear_pose(heard)
        except GpomError as error:
            if heard.type_name in {SCAN_TYPE, cdr.LASER_SCAN}:
                self._stream(heard).broken[str(error)] += 1
            else:
                self.troubles[f"{heard.topic} ({heard.way}): {error}"] += 1

    def report(self, announced: Mapping[tuple[Way, str], str] | None = None) -> list[StreamReport]:
        """Tell how every stream is, also those that are announced and never came."""
        for (way, topic), type_name in (announced or {}).items():
            if type_name == cdr.LASER_SCAN:
                self._streams.setdefault((way, topic), _Stream())
        return [self._judge(way, topic, self._streams[way, topic]) for way, topic in self._order()]

    def _order(self) -> Sequence[tuple[Way, str]]:
        return sorted(self._streams, key=lambda key: (key[1], key[0]))

    def _stream(self, heard: Heard) -> _Stream:
        return self._streams.setdefault((heard.way, heard.topic), _Stream())

    def _hear_native(self, heard: Heard) -> None:
        scan = wire.decode(heard.payload)
        stream = self._stream(heard)
        stream.beams = scan.ranges_m.size
        if scan.seq:
            stream.count(scan.boot.to_bytes(8, "little"), scan.seq)
        stream.came(scan.stamp_ns, heard.arrived_ns)

    def _hear_scan(self, heard: Heard) -> None:
        sweep = read_sweep(heard.payload, DEFAULT_MAX_BEAMS)
        stream = self._stream(heard)
        stream.beams, stream.frame = sweep.ranges_m.size, sweep.frame
        if heard.attachment is not None:
            origin = attachment.read(heard.attachment)
            stream.count(origin.gid, origin.sequence)
        stream.came(sweep.stamp_ns, heard.arrived_ns)

    def _hear_transforms(self, heard: Heard) -> None:
        gid = None if heard.attachment is None else attachment.read(heard.attachment).gid
        self._frames.hear_transforms(heard.topic, heard.payload, gid)

    def _hear_pose(self, heard: Heard) -> None:
        wanted = {"odometry": cdr.ODOMETRY, "pose": cdr.POSE}.get(self._pose_from)
        if heard.type_name == wanted:
            found = pose_of(cdr.decode(heard.payload, heard.type_name))
            self._frames.hear_pose(heard.topic, found, self._base_frame)

    def _judge(self, way: Way, topic: str, stream: _Stream) -> StreamReport:
        scans = len(stream.arrived_ns)
        ages_s = (
            np.array(stream.arrived_ns[: len(stream.stamps_ns)]) - np.array(stream.stamps_ns)
        ) / _NANOSECONDS
        placed, reasons = self._place(way, topic, stream)
        report = StreamReport(
            way=way,
            topic=topic,
            scans=scans,
            rate_hz=_rate_hz(stream.arrived_ns),
            beams=stream.beams,
            frame=stream.frame,
            lost=stream.lost,
            age_s=float(np.median(ages_s)) if scans else 0.0,
            placed=placed,
        )
        broken = [f"{count} scans cannot be read: {why}" for why, count in stream.broken.items()]
        return replace(
            report,
            problems=(*broken, *reasons, *_general_problems(report)),
            notes=tuple(_notes(report, len(stream.numbers))),
        )

    def _place(self, way: Way, topic: str, stream: _Stream) -> tuple[float, list[str]]:
        if way == "gpom" or not stream.stamps_ns:
            return 1.0, []
        scans = len(stream.stamps_ns)
        counts, reasons = self._frames.place(
            topic, zip(stream.frames, stream.stamps_ns, strict=True)
        )
        # Of the last scans the transforms are still on their way, and of the first ones nobody
        # was listening yet: only when most are so, something is wrong.
        bad = counts["unconnected"] > 0 or counts.total() > scans / 2
        quarrels = [
            quarrel
            for frame in sorted(set(stream.frames))
            for quarrel in self._frames.quarrels(topic, frame)
        ]
        placed = 1.0 - counts.total() / scans
        return placed, list(dict.fromkeys([*(reasons if bad else []), *quarrels]))


def _general_problems(report: StreamReport) -> list[str]:
    if report.scans == 0:
        return ["it is announced, but no scan came"]
    problems = []
    if report.lost:
        share = report.lost / (report.lost + report.scans)
        problems.append(f"{report.lost} scans ({share:.0%}) are lost on the way")
    if CLOCK_OFF_S < abs(report.age_s) < _DAY_S:
        way = "behind" if report.age_s > 0 else "ahead of"
        problems.append(
            f"scans are stamped {abs(report.age_s):.1f} s {way} the clock of this machine: "
            "synchronise the clocks (chrony), or look for a delay"
        )
    if report.scans > 1 and report.rate_hz < SLOW_HZ:
        problems.append(f"scans come only {report.rate_hz:.1f} times a second")
    return problems


def _notes(report: StreamReport, publishers: int) -> Iterator[str]:
    if report.way != "gpom" and publishers > 1:
        yield (
            f"{publishers} nodes publish on this topic; when they are two robots, each wants a "
            "namespace"
        )
    if abs(report.age_s) > _DAY_S:
        yield (
            "scans have simulation time (use_sim_time) or no stamp; fine where transforms have "
            "the same time"
        )
    chunks = report.topic.split("/")
    if report.way != "gpom" and (len(chunks) > 2 or chunks[-1] != "scan"):
        places = ["{robot}", "{sensor}"][: len(chunks) - 1]
        pattern = "/".join([*chunks[: -len(places) - 1], *places, chunks[-1]])
        yield (
            "the service hears this topic only when told to, perhaps by "
            f'ros.scan_topics: ["{pattern}"]'
        )


def _rate_hz(arrived_ns: Sequence[int]) -> float:
    if len(arrived_ns) < 2:
        return 0.0
    return (len(arrived_ns) - 1) / max((arrived_ns[-1] - arrived_ns[0]) / _NANOSECONDS, 1e-9)
