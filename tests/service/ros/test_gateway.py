import time
from contextlib import ExitStack

import numpy as np
import pytest

from gpom_core import wire
from gpom_core.ros import cdr as types
from service.ros.gateway import RosGateway
from service.ros_settings import RosSettings
from service.settings import ZenohSettings
from service.zenoh_source import ZenohSource
from tests.gpom_core.ros.samples import S, cdr, laser_scan, odometry, tf
from tests.service.conftest import wait_until
from tests.service.fleet_link import locator, open_session
from tests.service.ros.rmw import Talker, talker

LISTENING = ZenohSettings(listen=("tcp/127.0.0.1:0",))
BOTH = ("rmw_zenoh", "bridge")
SPEAKERS = [("rmw_zenoh", False), ("rmw_zenoh", True), ("bridge", False)]


class Sink:
    """Writes down what arrives."""

    def __init__(self) -> None:
        self.scans = []
        self.presence = []
        self.intake = {}
        self.refused = []

    def on_refused(self, reason, count) -> None:
        self.refused.append((reason, count))

    def on_scan(self, robot, sensor, payload) -> None:
        self.scans.append((robot, sensor, wire.decode(payload)))

    def on_presence(self, robot, alive) -> None:
        self.presence.append((robot, alive))

    def on_intake(self, robot, status) -> None:
        self.intake[robot] = status


@pytest.fixture
def sink() -> Sink:
    return Sink()


@pytest.fixture
def opened(sink):
    """Opens sources with a gateway, and closes them."""
    sources = []

    def open_source(*, zenoh=LISTENING, **settings) -> str | None:
        ros = RosSettings(**{"transports": BOTH, **settings})
        gateway = RosGateway(ros, beams_max=1000, robots_max=10)
        source = ZenohSource(zenoh, [gateway])
        source.open(sink)
        sources.append(source)
        return next(iter(source.endpoints()), None)

    yield open_source
    for source in sources:
        source.close()


@pytest.mark.parametrize(("transport", "humble"), SPEAKERS)
def test_scans_and_transforms_of_both_transports_arrive(sink, opened, transport, humble) -> None:
    with talker(opened(), transport, humble=humble) as robot:
        time.sleep(0.2)  # until the subscriptions are known there
        robot.say("r1/tf_static", tf(("base", "laser", (0.5, 0, 0), 0)))
        for second in range(4):
            robot.say("r1/tf", tf(("map", "base", (second, 0, 0), second * S)))
        robot.say("r1/scan", laser_scan(round(2.5 * S)))
        wait_until(lambda: len(sink.scans) == 1, 10.0)
        ((name, sensor, scan),) = sink.scans
        assert (name, sensor) == ("r1", "scan")
        assert scan.pose.x_m == pytest.approx(3.0)
        wait_until(lambda: "r1" in sink.intake, 5.0)


def test_a_domain_hears_its_own_robots_only(sink, opened) -> None:
    endpoint = opened(domain=42)
    with (
        talker(endpoint, "rmw_zenoh", domain=42) as ours,
        talker(endpoint, "rmw_zenoh", domain=0) as theirs,
    ):
        for name, robot in (("theirs", theirs), ("ours", ours)):
            robot.appear(f"{name}/scan", types.LASER_SCAN)
            robot.say(f"{name}/tf_static", tf(("map", "laser", (0, 0, 0), 0)))
            robot.say(f"{name}/scan", laser_scan(S))
        wait_until(lambda: len(sink.scans) == 1, 10.0)
        time.sleep(0.2)
    assert [robot for robot, _, _ in sink.scans] == ["ours"]
    assert {robot for robot, _ in sink.presence} == {"ours"}


def test_several_lasers_of_one_robot_are_told_apart(sink, opened) -> None:
    with talker(opened(scan_topics=("{robot}/{sensor}/scan",)), "rmw_zenoh") as robot:
        for sensor, x in (("front", 0.5), ("rear", -0.5)):
            robot.say("r1/tf_static", tf(("map", f"{sensor}_laser", (x, 0, 0), 0)))
            robot.say(f"r1/{sensor}/scan", laser_scan(S, f"{sensor}_laser"))
        wait_until(lambda: len(sink.scans) == 2, 10.0)
    found = {(name, sensor): scan.pose.x_m for name, sensor, scan in sink.scans}
    assert found == {("r1", "front"): 0.5, ("r1", "rear"): -0.5}


@pytest.mark.parametrize("transport", BOTH)
def test_who_comes_late_still_gets_fixed_transforms(sink, opened, transport) -> None:
    """The robot has said them before the service was there, and will not again."""
    endpoint = opened()
    with talker(endpoint, transport) as robot:
        robot.say("r1/tf_static", tf(("map", "laser", (1.0, 0, 0), 0)))
        late = Sink()
        source = ZenohSource(
            ZenohSettings(listen=(), connect=(endpoint,)),
            [RosGateway(RosSettings(transports=(transport,)), beams_max=99, robots_max=9)],
        )
        source.open(late)
        try:
            time.sleep(0.3)
            robot.say("r1/scan", laser_scan(S))
            wait_until(lambda: len(sink.scans) == 1, 10.0)
        finally:
            source.close()


@pytest.mark.parametrize("cache", ["@/{zid}/@ros2_pub_cache", "@ros2_pub_cache/{zid}"])
def test_older_bridges_are_asked_for_what_they_keep(sink, opened, cache) -> None:
    """They answer for another key than that of the question."""
    with talker(opened(transports=("bridge",)), "bridge") as robot:
        fixed = cdr(tf(("map", "laser", (1.0, 0, 0), 0)))
        key = f"{cache.format(zid=robot.session.zid())}/r1/tf_static"

        def answer(query) -> None:
            with query:
                query.reply("r1/tf_static", fixed)

        queryable = robot.session.declare_queryable(key, answer)
        robot.appear("r1/tf_static", types.TF_MESSAGE)
        time.sleep(0.3)
        robot.say("r1/scan", laser_scan(S))
        wait_until(lambda: len(sink.scans) == 1, 10.0)
        queryable.undeclare()


def on_a_router_of_its_own(held, connect=None) -> tuple[Talker, str]:
    """A node as rmw_zenoh has it: a peer, whose router passes nothing from peer to peer."""
    router = held.enter_context(open_session(connect=connect, mode="router", gossip=True))
    there = locator(router, "router")
    node = held.enter_context(open_session(connect=there, mode="peer", gossip=True))
    return Talker(node, "rmw_zenoh"), there


@pytest.mark.parametrize("service_connects", [True, False])
def test_nodes_on_their_own_router_are_heard(sink, opened, service_connects) -> None:
    with ExitStack() as held:
        if service_connects:
            node, there = on_a_router_of_its_own(held)
        else:
            node, _ = on_a_router_of_its_own(held, opened())
        node.say("r1/tf_static", tf(("map", "laser", (0.5, 0, 0), 0)))
        if service_connects:  # late, so that only the node's cache has the fixed transform
            opened(zenoh=ZenohSettings(listen=(), connect=(there,)))
        node.appear("r1/scan", types.LASER_SCAN)
        wait_until(lambda: sink.presence == [("r1", True)], 10.0)

        def heard() -> bool:  # routers that have just met lose samples, as they do of a lidar
            node.say("r1/scan", laser_scan(S))
            time.sleep(0.1)
            return bool(sink.scans)

        wait_until(heard, 10.0)


@pytest.mark.parametrize("transport", BOTH)
def test_caches_are_asked_again_while_a_scan_lacks_transforms(sink, opened, transport) -> None:
    """A cache that nobody could tell the service of, as happens while routers meet."""
    with talker(opened(), transport) as robot:
        time.sleep(0.3)  # the subscriber has asked, and heard nothing
        message = tf(("map", "laser", (1.0, 0, 0), 0))
        key = robot.key("r1/tf_static", types.TF_MESSAGE)

        def answer(query) -> None:
            with query:
                query.reply(key, cdr(message))

        queryable = robot.session.declare_queryable(f"{key}/@adv/pub/1/2/_", answer)
        robot.say("r1/scan", laser_scan(S))
        wait_until(lambda: len(sink.scans) == 1, 10.0)
        queryable.undeclare()


@pytest.mark.parametrize(("transport", "humble"), SPEAKERS)
def test_robots_come_and_go(sink, opened, transport, humble, caplog) -> None:
    with talker(opened(), transport, humble=humble) as robot:
        robot.appear("r1/camera/scan", types.LASER_SCAN)  # not one of ours
        robot.appear("r1/scan", types.LASER_SCAN)
        wait_until(lambda: sink.presence == [("r1", True)], 10.0)
        wait_until(lambda: "nobody takes the laser scans of /r1/camera/scan" in caplog.text, 10.0)
        robot.vanish()
        wait_until(lambda: sink.presence[-1] == ("r1", False), 10.0)


def test_odometry_instead_of_transforms(sink, opened) -> None:
    endpoint = opened(pose_from="odometry", scan_topics=("{robot}/{sensor}/scan",))
    with talker(endpoint, "rmw_zenoh") as robot:
        time.sleep(0.2)
        for second in (1, 2):
            robot.say("r7/odom", odometry(second * S, second, 0, 0, child="laser"))
        robot.say("r7/front/scan", laser_scan(S))
        wait_until(lambda: len(sink.scans) == 1, 10.0)
    assert sink.scans[0][:2] == ("r7", "front")
    assert sink.scans[0][2].pose.x_m == 1.0


def test_a_hostile_robot_is_counted_and_does_no_harm(sink, opened) -> None:
    with talker(opened(), "bridge") as robot:
        time.sleep(0.2)
        robot.session.put("evil/scan", b"\x00\x01\x00\x00" + b"\xff" * 64)
        robot.session.put("evil/tf", b"\x00\x01\x00\x00" + b"\xff" * 64)
        robot.say("r1/tf_static", tf(("map", "laser", (0, 0, 0), 0)))
        robot.say("r1/scan", laser_scan(S, ranges=np.ones(5)))
        wait_until(lambda: len(sink.scans) == 1, 10.0)
        wait_until(lambda: sink.intake.get("evil") is not None, 5.0)
        wait_until(lambda: sink.intake["evil"].dropped == {"bad_cdr": 2}, 5.0)


def test_scans_of_robots_that_have_no_room_are_counted(sink, opened) -> None:
    with talker(opened(), "rmw_zenoh") as robot:
        for number in range(12):
            robot.say(f"r{number}/scan", laser_scan(S))
        wait_until(lambda: sum(count for _, count in sink.refused) == 2, 10.0)
    assert {reason for reason, _ in sink.refused} == {"too_many_robots"}


def test_nothing_is_heard_when_it_is_off(sink, opened) -> None:
    with talker(opened(transports=()), "bridge") as robot:
        time.sleep(0.2)
        robot.say("r1/scan", laser_scan(S))
        time.sleep(0.3)
    assert not sink.scans
    assert not sink.intake
