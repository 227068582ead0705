"""An intake of ROS messages in a test, and a robot that speaks to it."""

from math import pi

import numpy as np

from gpom_core import wire
from gpom_core.ros.attachment import Attachment, write
from gpom_core.ros.keys import Origin
from service.clock import ManualClock
from service.ros.intake import Intake, RosMessage
from service.ros_settings import RosSettings
from tests.gpom_core.ros.samples import S, cdr, laser_scan, tf

R1 = Origin("r1", None)
NOBODY = Origin(None, None)
WHOLE = {"ranges": np.full(8, 2.0), "angle_increment": pi / 8}


class Rig:
    """An intake with what comes out of it."""

    def __init__(self, **settings) -> None:
        self.clock = ManualClock()
        self.scans = []
        self.intake = Intake(
            RosSettings(transports=("rmw_zenoh",), **settings),
            beams_max=1000,
            robots_max=3,
            deliver=lambda *item: self.scans.append(item),
            clock=self.clock,
        )
        self.sequence = 0

    def say(self, kind, message, origin=R1, beside=None) -> None:
        payload = message if isinstance(message, bytes) else cdr(message)
        self.intake.handle(RosMessage(kind, origin, payload, beside))

    def scan(self, stamp_ns, origin=R1, *, gid=b"g" * 16, number=None, **fields) -> None:
        self.sequence = self.sequence + 1 if number is None else number
        beside = write(Attachment(self.sequence, stamp_ns, gid))
        self.say("scan", laser_scan(stamp_ns, "laser", **{**WHOLE, **fields}), origin, beside)

    def drive(self, start_s=0, end_s=10, origin=R1) -> None:
        """The robot goes along x, 1 m a second; its laser is 0.5 m ahead."""
        for second in range(start_s, end_s + 1):
            self.say("tf", tf(("map", "base", (second, 0, 0), second * S)), origin)

    def mount(self, origin=R1) -> None:
        self.say("tf_static", tf(("base", "laser", (0.5, 0, 0), 0)), origin)

    def decoded(self):
        return [wire.decode(payload) for _, _, payload in self.scans]

    def status(self, robot="r1"):
        return self.intake.report()[robot]
