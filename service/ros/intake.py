"""What robots say, sorted by robot: scans and where their sensors were become scans of the map.

No zenoh and no thread: messages go in one by one, in the order they came.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import isfinite
from typing import Literal, get_args

import numpy as np

from gpom_core import wire
from gpom_core.errors import GpomError, InvalidScanError, InvalidTransformError, RosMessageError
from gpom_core.frames import FrameTree
from gpom_core.ros import attachment, cdr
from gpom_core.ros.keys import Origin
from gpom_core.ros.messages import pose_of, read_sweep, read_transforms
from gpom_core.scan import Scan
from service.clock import Clock
from service.fleet import IntakeStatus
from service.ros.stream import Placing, SensorStream, Tally
from service.ros_settings import RosSettings

logger = logging.getLogger(__name__)

Kind = Literal["scan", "tf", "tf_static", "pose"]
Deliver = Callable[[str, str, bytes], None]

_UNKNOWN = (0.0,) * 6
_DEFAULT_SENSOR = "scan"
_SENSORS_MAX = 64  # of one robot


@dataclass(frozen=True, slots=True)
class RosMessage:
    """A message as it came in: not decoded, not trusted.

    Attributes:
        kind: what its topic carries.
        origin: whose topic it is.
        payload: CDR.
        attachment: as rmw_zenoh writes it; None from a bridge.
    """

    kind: Kind
    origin: Origin
    payload: bytes
    attachment: bytes | None = None


@dataclass(slots=True)
class _Robot:
    tree: FrameTree
    tally: Tally = field(default_factory=Tally)
    streams: dict[str, SensorStream] = field(default_factory=dict)
    covariance: tuple[float, ...] = _UNKNOWN
    age_s: float | None = None


class Intake:
    """All robots. Owned by one thread.

    Args:
        settings: of ROS.
        beams_max: a scan with more is refused.
        robots_max: messages of further robots are refused.
        deliver: takes robot, sensor and the bytes of a scan.
        clock: for waiting.
    """

    def __init__(
        self,
        settings: RosSettings,
        *,
        beams_max: int,
        robots_max: int,
        deliver: Deliver,
        clock: Clock,
    ) -> None:
        self._settings = settings
        self._beams_max = beams_max
        self._robots_max = robots_max
        self._deliver = deliver
        self._clock = clock
        self._shared = FrameTree()
        self._robots: dict[str, _Robot] = {}
        self._placing = Placing(
            settings.map_frame, settings.wait_s, settings.waiting_max, settings.correct_motion
        )
        self.strangers = 0

    def handle(self, message: RosMessage) -> None:
        """Take a message; what is wrong with it is counted at its robot."""
        robot = self._robot(message)
        if robot is None:
            if message.kind == "scan":
                self._refuse_stranger(message.origin.robot or self._settings.robot)
            return
        name, state = robot
        try:
            if message.kind == "scan":
                self._take_scan(state, message)
            elif message.kind == "pose":
                self._take_pose(state, message.payload)
            else:
                self._take_transforms(state, message)
        except (RosMessageError, InvalidTransformError) as error:
            reason = error.reason if isinstance(error, RosMessageError) else "bad_transform"
            about = _about(message.kind)
            state.tally.drop(reason, about, _named(message.kind, error), self._clock.unix_s())
            logger.debug("%s of %s refused: %s", message.kind, name, error)
        if message.kind in {"scan", "pose"} or message.origin.robot is not None:
            self._pass_on(name, state)
        else:
            self.tick()

    def tick(self) -> None:
        """Pass on what can be, and drop what waited too long; to be called often."""
        for name, state in self._robots.items():
            self._pass_on(name, state)

    def unconnected(self) -> int:
        """Count attempts to place scans in vain, as nothing connects their frame with the map."""
        return sum(state.tally.unconnected for state in self._robots.values())

    def report(self) -> dict[str, IntakeStatus]:
        """Tell how it goes with every robot that sends scans."""
        unix_s = self._clock.unix_s()
        return {
            name: _status(state, unix_s)
            for name, state in self._robots.items()
            if state.tally.received
        }

    def _robot(self, message: RosMessage) -> tuple[str, _Robot] | None:
        name = message.origin.robot or self._settings.robot
        state = self._robots.get(name)
        if state is None:
            if message.origin.robot is None and message.kind in {"tf", "tf_static"}:
                # Transforms of the whole fleet make no robot.
                return name, _Robot(self._shared)
            if len(self._robots) >= self._robots_max:
                return None
            state = self._robots[name] = _Robot(FrameTree(self._shared))
        return name, state

    def _refuse_stranger(self, name: str) -> None:
        if self.strangers == 0:
            logger.warning(
                "scans of %s are refused, as those of all further robots: the setting "
                "ingest.robots_max allows %d",
                name,
                self._robots_max,
            )
        self.strangers += 1

    def _take_scan(self, state: _Robot, message: RosMessage) -> None:
        state.tally.received += 1
        sweep = read_sweep(message.payload, self._beams_max)
        origin = None if message.attachment is None else attachment.read(message.attachment)
        unix_s = self._clock.unix_s()
        state.age_s = unix_s - sweep.stamp_ns / 1e9
        sensor = message.origin.sensor or _DEFAULT_SENSOR
        stream = state.streams.get(sensor)
        if stream is None:
            if len(state.streams) >= _SENSORS_MAX:
                words = f"{sensor} is one sensor too many; at most {_SENSORS_MAX} are followed"
                raise RosMessageError("too_many_sensors", words)
            stream = state.streams[sensor] = SensorStream(self._placing, state.tree, state.tally)
        stream.add(sweep, origin, self._clock.monotonic_s(), unix_s)

    def _take_transforms(self, state: _Robot, message: RosMessage) -> None:
        tree = self._shared if message.origin.robot is None else state.tree
        fixed = message.kind == "tf_static"
        for item in read_transforms(message.payload):
            stamp_ns = None if fixed else item.stamp_ns
            if not tree.add(item.parent, item.child, item.pose, stamp_ns):
                raise RosMessageError("too_many_frames", "there are too many frames to follow")

    def _take_pose(self, state: _Robot, payload: bytes) -> None:
        kind = cdr.ODOMETRY if self._settings.pose_from == "odometry" else cdr.POSE
        found = pose_of(cdr.decode(payload, kind))
        child = found.child or self._settings.base_frame
        state.tree.add(self._settings.map_frame, child, found.pose, found.stamp_ns)
        known = all(map(isfinite, found.covariance))
        state.covariance = found.covariance if known else _UNKNOWN

    def _pass_on(self, name: str, state: _Robot) -> None:
        for sensor, stream in state.streams.items():
            if len(stream) == 0:
                continue
            now_s, unix_s = self._clock.monotonic_s(), self._clock.unix_s()
            for scan in stream.placed(lambda: state.covariance, now_s, unix_s):
                try:
                    payload = wire.encode(self._believed(scan))
                except InvalidScanError as error:
                    state.tally.drop(error.reason, _about("scan"), str(error), unix_s)
                else:
                    self._deliver(name, sensor, payload)

    def _believed(self, scan: Scan) -> Scan:
        """Say of no-returns what the settings say of them."""
        settings = self._settings
        ceiling_m = settings.range_ceiling_m
        nothing = scan.no_returns()
        if ceiling_m is not None:
            nothing |= scan.ranges_m >= ceiling_m
        if not nothing.any() or (settings.no_returns == "free" and ceiling_m is None):
            return scan
        meaning = np.inf if settings.no_returns == "free" else np.nan
        ranges_m = np.where(nothing, np.float32(meaning), scan.ranges_m)
        # Nobody has looked beyond the ceiling.
        range_max_m = min(scan.range_max_m, ceiling_m or np.inf)
        return replace(scan, ranges_m=ranges_m, range_max_m=range_max_m)


def _about(kind: Kind) -> str:
    return f"messages of {kind}"  # no frame has a blank in its name


def _named(kind: Kind, error: GpomError) -> str:
    return str(error) if kind == "scan" else f"a message of {kind} cannot be used: {error}"


def _status(state: _Robot, unix_s: float) -> IntakeStatus:
    tally = state.tally
    # Messages that cannot be read clear nothing when they stop.
    tally.troubles.forget(map(_about, get_args(Kind)), unix_s)
    return IntakeStatus(
        received=tally.received,
        waiting=sum(map(len, state.streams.values())),
        delayed=tally.delayed,
        uncorrected=tally.uncorrected,
        dropped=dict(tally.dropped),
        age_s=state.age_s,
        problem=tally.troubles.told(),
    )
