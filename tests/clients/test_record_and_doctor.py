"""Both commands on a real network: robots on a router, the commands beside them."""

import json
import threading
import time
from contextlib import ExitStack, suppress

import pytest
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability
from typer.testing import CliRunner

from clients.cli import app
from clients.listener import Listener, ListenerSettings, named
from clients.log_reader import ReadOptions
from clients.logs import open_log
from clients.record import BagRecorder
from gpom_core.errors import ConfigurationError
from gpom_core.ros import cdr as types
from tests.clients.conftest import running_map
from tests.gpom_core.ros.samples import S, laser_scan, tf
from tests.service.fleet_link import open_session
from tests.service.rooms import payload_at, scan_at
from tests.service.ros.rmw import talker


@pytest.fixture
def router():
    with running_map() as fake:
        yield fake.endpoint


@pytest.fixture
def fleet(router):
    """Robots by rmw_zenoh, by a bridge, and a native one, which talk until the test is over."""
    stop = threading.Event()
    with (
        talker(router, "rmw_zenoh") as r1,
        talker(router, "bridge") as r2,
        open_session(connect=router) as native,
    ):
        speakers = {"r1": r1, "r2": r2}
        for name, speaker in speakers.items():
            speaker.appear(f"{name}/scan", types.LASER_SCAN)
            for topic in ("tf", "tf_static"):
                speaker.appear(f"{name}/{topic}", types.TF_MESSAGE)
            speaker.say(f"{name}/tf_static", tf(("base", "laser", (0.5, 0, 0), 0)))

        def talk() -> None:
            number = 0
            while not stop.wait(0.05):
                number += 1
                now_ns = time.time_ns()
                for name, speaker in speakers.items():
                    speaker.say(f"{name}/tf", tf(("map", "base", (number, 0, 0), now_ns)))
                    speaker.say(f"{name}/scan", laser_scan(now_ns))
                native.put(
                    "gpom/v1/site/r3/scan/laser",
                    payload_at(0.5, 1.0, seq=number, stamp_ns=now_ns),
                )

        thread = threading.Thread(target=talk)
        thread.start()
        yield router
        stop.set()
        thread.join()


def run(*args):
    return CliRunner().invoke(app, args)


def test_a_fleet_is_recorded_and_replayed(fleet, tmp_path) -> None:
    bag = tmp_path / "bag"
    result = run("record", str(bag), "--seconds", "1.5", "--connect", fleet)
    assert result.exit_code == 0, result.output
    for topic in ("/r1/scan", "/r1/tf_static", "/r2/tf", "/r3/laser"):
        assert f"{topic}: " in result.stdout
    for robot in ("r1", "r2"):
        log = open_log(bag, ReadOptions(topic=f"/{robot}/scan"))
        assert len(log) >= 5
        assert all(scan.pose.x_m % 1.0 == 0.5 for scan in log)
    with AnyReader([bag]) as reader:
        offered = {c.topic: c.ext.offered_qos_profiles for c in reader.connections}
    (fixed,) = offered["/r1/tf_static"]
    assert fixed.durability is QosDurability.TRANSIENT_LOCAL
    assert not offered["/r1/scan"]
    native = list(open_log(bag, ReadOptions(topic="/r3/laser")))
    assert native[0].pose[:2] == (0.5, 1.0)
    assert native[0].ranges_m == pytest.approx(scan_at(0.5, 1.0).ranges_m)


def test_the_doctor_finds_a_healthy_fleet_well(fleet) -> None:
    result = run("doctor", "--seconds", "1.5", "--json", "--connect", fleet)
    answer = json.loads(result.stdout)
    assert [stream["topic"] for stream in answer["streams"]] == ["r1/scan", "r2/scan", "r3/laser"]
    assert [stream["problems"] for stream in answer["streams"]] == [[], [], []]
    assert answer["problems"] == []
    assert result.exit_code == 0


def test_the_doctor_says_what_is_missing(router) -> None:
    with talker(router, "rmw_zenoh") as lost:
        lost.appear("r1/scan", types.LASER_SCAN)
        result = run("doctor", "--seconds", "0.5", "--connect", router)
    assert "r1/scan (rmw_zenoh): 0 scans" in result.stdout
    assert "! it is announced, but no scan came" in result.stdout
    assert "1 thing to look at" in str(result.exception)


def test_the_doctor_finds_every_fault_of_a_sick_fleet(router) -> None:
    stop = threading.Event()
    names = ("lost", "mistaken", "slow", "holey", "late")
    with ExitStack() as held:
        fleet = {name: held.enter_context(talker(router, "rmw_zenoh")) for name in names}

        def talk() -> None:
            for number in range(10_000):
                now_ns = time.time_ns()
                for name, robot in fleet.items():
                    if name != "lost":
                        robot.say(f"{name}/tf", tf(("map", "laser", (0, 0, 0), now_ns)))
                    if name == "holey" and number % 4 == 0:
                        robot.skip(f"{name}/scan")
                    elif name != "slow" or number % 30 == 0:
                        frame = "lasr" if name == "mistaken" else "laser"
                        stamp_ns = now_ns - (3 * S if name == "late" else 0)
                        robot.say(f"{name}/scan", laser_scan(stamp_ns, frame))
                if stop.wait(0.05):
                    return

        thread = threading.Thread(target=talk)
        thread.start()
        result = run("doctor", "--seconds", "4", "--json", "--connect", router)
        stop.set()
        thread.join()
    found = {
        stream["topic"]: " ".join(stream["problems"])
        for stream in json.loads(result.stdout)["streams"]
    }
    assert "no transforms at all" in found["lost/scan"]
    assert "no frame is called lasr" in found["mistaken/scan"]
    assert "scans come only 0." in found["slow/scan"]
    assert "are lost on the way" in found["holey/scan"]
    assert "3.0 s behind the clock" in found["late/scan"]
    assert "synchronise the clocks" in found["late/scan"]
    assert result.exit_code == 1


def test_the_doctor_of_nobody(router) -> None:
    result = run("doctor", "--seconds", "0.3", "--connect", router, "--prefix", "elsewhere")
    assert "no map service is alive under the prefix elsewhere" in result.stdout
    assert "nobody publishes laser scans" in result.stdout
    assert "2 things to look at" in str(result.exception)


def test_a_bag_is_never_written_over_and_never_silently_empty(router, tmp_path) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "file").touch()
    with pytest.raises(ConfigurationError, match="exists already"):
        BagRecorder(tmp_path / "there")
    with pytest.raises(ConfigurationError, match="cannot write"):
        BagRecorder(tmp_path / "file" / "bag")
    before = sorted(tmp_path.rglob("*"))
    folder = tmp_path / "there" / "far" / "bag"
    result = run("record", str(folder), "--seconds", "0.2", "--connect", router)
    assert f"nobody published anything, so there is no bag at {folder}" in str(result.exception)
    assert sorted(tmp_path.rglob("*")) == before, "nor what was made for it"


def test_an_empty_bag_takes_nothing_with_it_that_is_not_its_own(tmp_path) -> None:
    with BagRecorder(tmp_path / "far" / "bag"):
        (tmp_path / "far" / "bag" / "notes.txt").write_text("of somebody")
        (tmp_path / "far" / "else").mkdir()
    left = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*"))
    assert left == ["far", "far/bag", "far/bag/notes.txt", "far/else"]
    with suppress(KeyboardInterrupt), BagRecorder(tmp_path / "near" / "bag"):
        raise KeyboardInterrupt
    assert not (tmp_path / "near").exists()


def test_what_is_put_for_many_is_of_nobody(silent_map, caplog) -> None:
    """A key with wildcards reaches every subscriber that it meets, and names no robot."""
    session = silent_map.session
    tokens = [session.liveliness().declare_token(key) for key in ("@ros2_lv/**", "@/*/@ros2_lv/**")]
    listener = Listener(session, ListenerSettings(named(None), 0, "gpom/v1/site"))
    for key in ("**", "gpom/v1/site/**", "gpom/v1/site/r1/scan/*", "0/**", "0/r1/*/x"):
        session.put(key, b"for many")
    session.put("gpom/v1/site/r1/scan/laser", b"for one")
    found = next(listener.messages(10.0, threading.Event()))
    listener.close()
    assert (found.topic, found.payload) == ("r1/laser", b"for one")
    assert listener.announced == {}
    assert [record for record in caplog.records if record.name.startswith("zenoh")] == []
    for token in tokens:
        token.undeclare()


def test_fixed_transforms_are_heard_by_who_comes_late(router) -> None:
    with talker(router, "rmw_zenoh") as robot, open_session(connect=router) as session:
        robot.say("r1/tf_static", tf(("base", "laser", (0.5, 0, 0), S)))
        listener = Listener(session, ListenerSettings(("rmw_zenoh",), 0, "gpom/v1/site"))
        found = next(listener.messages(10.0, threading.Event()))
        listener.close()
    assert found.topic == "r1/tf_static"
