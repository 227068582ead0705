"""Coordinate frames of robots: who is where in whom, at which time.

Frames form a tree; each has its pose in its parent, fixed or moving. Between two moments a moving
pose is interpolated; outside what is known it is not guessed.
"""

from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass, field

from gpom_core.errors import UnknownPoseError
from gpom_core.transforms import IDENTITY, Rigid, compose, interpolate, inverse

KEEP_S = 30.0
"""How much of the past a tree remembers, by the stamps of its own frames."""
MOMENTS_MAX = 20_000
"""Remembered moments of one frame: 30 s at more than 600 Hz."""
FRAMES_MAX = 1_000
"""Frames of one tree; more are not taken."""
SET_BACK_S = 5.0
"""Stamps that go back by more than this: the clock was set back, or a simulation began anew."""

_NANOSECONDS = 1e9
_LONGEST_CHAIN = 100
_TRIM_EVERY = 256
_SET_BACK_NS = round(SET_BACK_S * _NANOSECONDS)
_DAY_S = 86_400.0
_MOST_NAMED = 3


@dataclass(slots=True)
class _Track:
    """The poses of one frame in its parent, ordered by time."""

    parent: str
    rival: str | None = None  # the parent it had before
    stamps_ns: list[int] = field(default_factory=list)
    poses: list[Rigid] = field(default_factory=list)
    fixed: Rigid | None = None

    def add(self, stamp_ns: int, pose: Rigid, keep_ns: int | None) -> None:
        if keep_ns is not None:
            self.set_back(stamp_ns)
        at = len(self.stamps_ns)
        if at and stamp_ns <= self.stamps_ns[-1]:
            at = bisect_left(self.stamps_ns, stamp_ns)
            if self.stamps_ns[at] == stamp_ns:
                self.poses[at] = pose
                return
        self.stamps_ns.insert(at, stamp_ns)
        self.poses.insert(at, pose)
        if keep_ns is not None and len(self.stamps_ns) % _TRIM_EVERY == 0:
            self._trim(keep_ns)

    def set_back(self, stamp_ns: int) -> None:
        """Forget all when it lies ahead of a clock that was set back: it is of another run."""
        if self.stamps_ns and self.stamps_ns[-1] - stamp_ns > _SET_BACK_NS:
            self.stamps_ns.clear()
            self.poses.clear()

    def at(self, stamp_ns: int, child: str) -> Rigid:
        if self.fixed is not None:
            return self.fixed
        stamps_ns = self.stamps_ns
        if not stamps_ns:
            message = f"the transform from {self.parent} to {child} has not come since the clock"
            raise UnknownPoseError("too_new", f"{message} was set back")
        after = bisect_left(stamps_ns, stamp_ns)
        if after < len(stamps_ns) and stamps_ns[after] == stamp_ns:
            return self.poses[after]
        if after == len(stamps_ns):
            apart_s = (stamp_ns - stamps_ns[-1]) / _NANOSECONDS
            known = f"is known up to {apart_s:.3f} s before the scan"
            raise UnknownPoseError("too_new", self._message(child, known, apart_s))
        if after == 0:
            apart_s = (stamps_ns[0] - stamp_ns) / _NANOSECONDS
            known = f"is known only from {apart_s:.3f} s after the scan on"
            raise UnknownPoseError("too_old", self._message(child, known, apart_s))
        start_ns, end_ns = stamps_ns[after - 1], stamps_ns[after]
        fraction = (stamp_ns - start_ns) / (end_ns - start_ns)
        return interpolate(self.poses[after - 1], self.poses[after], fraction)

    def _message(self, child: str, known: str, apart_s: float) -> str:
        message = f"the transform from {self.parent} to {child} {known}"
        if apart_s > _DAY_S:
            message += ": one of them has simulation time (use_sim_time), or no stamp"
        if self.rival is not None:
            message += f"; {child} is said to hang on {self.rival} too: which is right?"
        return message

    def _trim(self, keep_ns: int) -> None:
        old = bisect_left(self.stamps_ns, self.stamps_ns[-1] - keep_ns)
        old = max(old, len(self.stamps_ns) - MOMENTS_MAX)
        del self.stamps_ns[:old]
        del self.poses[:old]


class FrameTree:
    """The frames of one robot. Not thread-safe.

    Args:
        shared: frames of the whole fleet, which complete those of this tree.
        keep_s: how much of the past to remember; None for all of it.
    """

    def __init__(self, shared: "FrameTree | None" = None, keep_s: float | None = KEEP_S) -> None:
        self._shared = shared
        self._keep_ns = None if keep_s is None else round(keep_s * _NANOSECONDS)
        self._tracks: dict[str, _Track] = {}

    def add(self, parent: str, child: str, pose: Rigid, stamp_ns: int | None) -> bool:
        """Learn where a frame is in its parent at one moment; None for always.

        A frame has one parent: a new one replaces the old one and all that was known of it.

        Returns:
            False when there are too many frames.
        """
        track = self._tracks.get(child)
        if track is None or track.parent != parent:
            if track is None and len(self._tracks) >= FRAMES_MAX:
                return False
            rival = None if track is None else track.parent
            track = self._tracks[child] = _Track(parent, rival)
        if stamp_ns is None:
            track.fixed = pose
        else:
            track.fixed = None
            track.add(stamp_ns, pose, self._keep_ns)
        return True

    def lookup(self, target: str, source: str, stamp_ns: int) -> Rigid:
        """Give the pose of `source` in `target` at a moment.

        Raises:
            UnknownPoseError: the frames are not connected (``unconnected``, may come), not known
                that late yet (``too_new``, will come) or not that early (``too_old``).
        """
        if source == target:
            return IDENTITY
        pose, at = IDENTITY, source
        passed = {source: IDENTITY}
        for child, track in self._way_up(source):
            pose, at = compose(track.at(stamp_ns, child), pose), track.parent
            if at == target:
                return pose
            passed[at] = pose
        # Not above: perhaps on another branch, below a frame that was passed.
        other = IDENTITY
        for child, track in self._way_up(target):
            other = compose(track.at(stamp_ns, child), other)
            if track.parent in passed:
                return compose(inverse(other), passed[track.parent])
        raise UnknownPoseError("unconnected", self._explain(target, source, at))

    def set_back(self, source: str, stamp_ns: int) -> None:
        """Note that the clock of a frame's robot was set back, as when a simulation begins anew.

        What is known of the way up from the frame and lies far ahead is of the run before.
        """
        for _, track in self._way_up(source):
            track.set_back(stamp_ns)

    def rivals(self, source: str) -> Iterator[tuple[str, str, str]]:
        """Give the frames on the way up that had another parent before: frame, parent, before."""
        for child, track in self._way_up(source):
            if track.rival is not None:
                yield child, track.parent, track.rival

    def frames(self) -> dict[str, str]:
        """Give the parent of every frame that has one."""
        own = {child: track.parent for child, track in self._tracks.items()}
        return own if self._shared is None else self._shared.frames() | own

    def _way_up(self, frame: str) -> Iterator[tuple[str, _Track]]:
        for _ in range(_LONGEST_CHAIN):  # frames that go round in a circle must not hang anything
            track = self._track(frame)
            if track is None:
                return
            yield frame, track
            frame = track.parent

    def _track(self, child: str) -> _Track | None:
        track = self._tracks.get(child)
        if track is None and self._shared is not None:
            return self._shared._track(child)
        return track

    def _explain(self, target: str, source: str, root: str) -> str:
        start = f"no transform from {target} to {source}"
        known = self.frames()
        if not known:
            return f"{start}: no transforms at all"
        names = {*known, *known.values()}
        if source not in names:
            return f"{start}: no frame is called {source}{_or_similar(source, names)}"
        if target not in names:
            hangs = f"{source} hangs on {root}{_or_similar(target, names)}"
            return f"{start}: no frame is called {target}; {hangs}"
        return f"{start}: {source} hangs on {root}, which has no connection to {target}"


def _or_similar(name: str, names: set[str]) -> str:
    """Name frames that differ in their prefix only: that is how most are mistaken."""
    last = name.rpartition("/")[2]
    similar = sorted(other for other in names if other.rpartition("/")[2] == last)
    return f", but there is {', '.join(similar[:_MOST_NAMED])}" if similar else ""
