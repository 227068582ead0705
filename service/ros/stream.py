"""The scans of one sensor on their way from a message to a scan with a pose."""

from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from gpom_core.errors import InvalidScanError, UnknownPoseError
from gpom_core.frames import SET_BACK_S, FrameTree
from gpom_core.ros.attachment import Attachment
from gpom_core.scan import Scan
from gpom_core.sweep import Stream, Sweep, to_scan, to_still_scan
from service.ros.troubles import Troubles

_PATIENCE_S = 0.5  # transforms come a little after the scans; that alone is no problem
_SET_BACK_NS = round(SET_BACK_S * 1e9)
_PUBLISHERS_MAX = 16  # of one sensor, remembered
_FRAMES_MAX = 16  # likewise
_GAP_MAX = 1_000_000  # who jumps by more has begun to count anew


@dataclass(frozen=True, slots=True)
class Placing:
    """How sweeps are placed.

    Attributes:
        map_frame: the frame of the map.
        wait_s: how long a sweep waits for its transforms.
        waiting_max: how many do.
        correct_motion: whether motion within a sweep is taken out.
    """

    map_frame: str
    wait_s: float
    waiting_max: int
    correct_motion: bool


@dataclass(slots=True)
class Tally:
    """What became of the scans of one robot.

    Attributes:
        received: messages.
        delayed: had to wait for a transform, and got it.
        uncorrected: motion within the sweep is left in, as the transform at its end did not come.
        dropped: by reason.
        unconnected: attempts to place scans that waited long enough for frames to be connected.
        troubles: what is wrong now.
    """

    received: int = 0
    delayed: int = 0
    uncorrected: int = 0
    dropped: Counter[str] = field(default_factory=Counter)
    unconnected: int = 0
    troubles: Troubles = field(default_factory=Troubles)

    def drop(self, reason: str, about: str, problem: str, unix_s: float) -> None:
        """Count a scan that comes to nothing; the rest as `Troubles.note`."""
        self.dropped[reason] += 1
        self.troubles.note(about, problem, unix_s)


@dataclass(slots=True)
class _Publisher:
    sequence: int
    source_ns: int


@dataclass(slots=True)
class _Waiting:
    sweep: Sweep
    boot: int
    seq: int
    arrived_s: float


class SensorStream:
    """One sensor: sweeps go in, scans come out in the same order. Owned by one thread.

    rmw_zenoh numbers the messages of a publisher. The numbers of the scans follow them, so that
    what was lost on the way is a gap, and what was dropped here is none. Several publishers may
    share a topic: each is followed by its own numbers.
    """

    def __init__(self, placing: Placing, tree: FrameTree, tally: Tally) -> None:
        self._placing = placing
        self._tree = tree
        self._tally = tally
        self._waiting: deque[_Waiting] = deque()
        self._publishers: dict[bytes, _Publisher] = {}
        self._boot = 0
        self._seq = 0
        self._dropped_here = 0
        self._held_up = 0  # of those that wait, so many were here when the first had to
        self._stamps_ns: dict[str, int] = {}  # last one of each frame: lasers may share a topic

    def __len__(self) -> int:
        """Sweeps that wait."""
        return len(self._waiting)

    def add(self, sweep: Sweep, origin: Attachment | None, now_s: float, unix_s: float) -> None:
        """Take a sweep in."""
        step = self._step(origin)
        if step == 0:
            self._tally.dropped["repeated"] += 1
            return
        if step is None:  # a publisher that is new, or was started anew
            self._boot = max(round(unix_s * 1e9), self._boot + 1)
            self._seq = self._dropped_here = 0
        self._seq += step or 1
        if self._stamps_ns.pop(sweep.frame, sweep.stamp_ns) - sweep.stamp_ns > _SET_BACK_NS:
            self._tree.set_back(sweep.frame, sweep.stamp_ns)
        self._stamps_ns[sweep.frame] = sweep.stamp_ns
        if len(self._stamps_ns) > _FRAMES_MAX:
            self._stamps_ns.pop(next(iter(self._stamps_ns)))
        if len(self._waiting) >= self._placing.waiting_max:
            self._drop("waiting_full", "too many scans wait for their transforms", unix_s)
        self._waiting.append(_Waiting(sweep, self._boot, self._seq, now_s))

    def _step(self, origin: Attachment | None) -> int | None:
        """Tell by how much the number grows: more than 1 after a gap, 0 for a repetition."""
        if origin is None:
            return 1 if self._boot else None
        last = self._publishers.pop(origin.gid, None)
        self._publishers[origin.gid] = _Publisher(origin.sequence, origin.source_ns)
        if len(self._publishers) > _PUBLISHERS_MAX:
            self._publishers.pop(next(iter(self._publishers)))
        if last is None:
            return None
        step = origin.sequence - last.sequence
        if step > 0:
            return step if step <= _GAP_MAX else None
        if origin.source_ns > last.source_ns:  # numbers begin again under the same name
            return None
        self._publishers[origin.gid] = last
        return 0

    def placed(
        self, covariance: Callable[[], tuple[float, ...]], now_s: float, unix_s: float
    ) -> Iterator[Scan]:
        """Give the scans whose transforms are known; drop those that waited in vain."""
        while self._waiting:
            head = self._waiting[0]
            expired = now_s - head.arrived_s > self._placing.wait_s
            try:
                scan = self._place(head, covariance(), expired)
            except UnknownPoseError as error:
                patient = now_s - head.arrived_s <= _PATIENCE_S
                self._tally.unconnected += error.reason == "unconnected" and not patient
                if error.reason == "too_old":
                    self._drop("late", str(error), unix_s)
                elif expired:
                    self._drop("no_transform", str(error), unix_s)
                else:
                    self._held_up = len(self._waiting)
                    if not patient:
                        self._tally.troubles.note(head.sweep.frame, str(error), unix_s)
                    return
            except InvalidScanError as error:
                self._drop(error.reason, str(error), unix_s)
            else:
                self._tally.delayed += self._held_up > 0
                self._pop()
                self._tally.troubles.clear(head.sweep.frame)
                yield scan

    def _place(self, head: _Waiting, covariance: tuple[float, ...], expired: bool) -> Scan:
        sweep, placing = head.sweep, self._placing
        first = self._tree.lookup(placing.map_frame, sweep.frame, sweep.stamp_ns)
        # Numbers of a publisher that is gone are not shifted by what was dropped since.
        shift = self._dropped_here if head.boot == self._boot else 0
        number = Stream(head.boot, max(head.seq - shift, 1))
        end_ns = sweep.last_stamp_ns
        if end_ns == sweep.stamp_ns or not placing.correct_motion:
            return to_scan(sweep, first, covariance, number)
        try:
            last = self._tree.lookup(placing.map_frame, sweep.frame, end_ns)
        except UnknownPoseError:
            if not expired:
                raise
            self._tally.uncorrected += 1
            return to_scan(sweep, first, covariance, number)
        return to_still_scan(sweep, first, last, covariance, number)

    def _drop(self, reason: str, problem: str, unix_s: float) -> None:
        head = self._pop()
        self._dropped_here += head.boot == self._boot
        self._tally.drop(reason, head.sweep.frame, problem, unix_s)

    def _pop(self) -> _Waiting:
        self._held_up = max(self._held_up - 1, 0)
        return self._waiting.popleft()
