"""Processes are killed, stopped and cut off while robots drive; nothing is lost, nothing twice."""

import random
import signal
import time

import pytest

from tests.faults.parts import Robot, Router, Service, assert_nothing_lost, until

SHORT_AND_LONG = [
    pytest.param(1, id="short"),
    pytest.param(10, marks=[pytest.mark.fault, pytest.mark.timeout(2400)], id="long"),
]


def fleet(endpoint: str, robots: int = 4, rate_hz: float = 100.0) -> list[Robot]:
    return [Robot(f"robot-{i + 1}", endpoint, rate_hz) for i in range(robots)]


def report(what: str, **numbers: object) -> None:
    print(what, *(f"{name}={value}" for name, value in numbers.items()))


@pytest.mark.timeout(2400)
@pytest.mark.parametrize("kills", SHORT_AND_LONG)
def test_the_service_is_killed_while_robots_send(tmp_path, run, kills) -> None:
    router = Router(tmp_path)
    run(router)
    service = Service(tmp_path, connect=router.endpoint)
    run(service)
    service.wait_ready()
    robots = fleet(router.endpoint)
    run(*robots)
    chance, restarts = random.Random(7), []
    for _ in range(kills):
        time.sleep(chance.uniform(0.5, 3.0))
        service.kill()
        time.sleep(chance.uniform(0.0, 0.5))
        service.start()
        restarts.append(service.wait_ready())
    time.sleep(1.0)
    for robot in robots:
        robot.finish()
    total = assert_nothing_lost(service, robots)
    slowest_s = round(max(restarts), 1)
    report("service killed", kills=kills, scans=total, lost=0, ready_after_s=slowest_s)


@pytest.mark.timeout(1200)
@pytest.mark.parametrize("kills", SHORT_AND_LONG)
def test_the_router_is_killed_and_restarted(tmp_path, run, kills) -> None:
    router = Router(tmp_path)
    run(router)
    service = Service(tmp_path, connect=router.endpoint)
    run(service)
    service.wait_ready()
    robots = fleet(router.endpoint, 2, 50.0)
    run(*robots)
    for _ in range(kills):
        time.sleep(1.0)
        router.kill()
        until(lambda: not service.is_ready(), 30.0, "readiness tells that the router is gone")
        router.start()
        service.wait_ready()
    time.sleep(1.0)
    for robot in robots:
        robot.finish()
    total = assert_nothing_lost(service, robots)
    report("router killed", kills=kills, scans=total, lost=0)


@pytest.mark.fault
@pytest.mark.timeout(300)
def test_the_service_is_stopped_for_eight_seconds(tmp_path, run) -> None:
    service = Service(tmp_path)
    run(service)
    service.wait_ready()
    robots = fleet(service.endpoint, 4, 50.0)
    run(*robots)
    time.sleep(1.0)
    service.send(signal.SIGSTOP)
    time.sleep(8.0)
    service.send(signal.SIGCONT)
    time.sleep(1.0)
    for robot in robots:
        robot.finish()
    total = assert_nothing_lost(service, robots)
    report("service stopped for 8 s", scans=total, lost=0)


@pytest.mark.fault
@pytest.mark.timeout(300)
def test_a_robot_sends_a_hundred_times_too_fast(tmp_path, run) -> None:
    service = Service(tmp_path)
    run(service)
    service.wait_ready()
    calm = fleet(service.endpoint, 1, 10.0)
    wild = Robot("wild", service.endpoint, 1000.0, scans_max=512)
    run(*calm, wild)
    time.sleep(10.0)
    start = time.monotonic()
    assert service.get("/v1/query?x=0&y=0").is_success
    answered_s = time.monotonic() - start
    for robot in (*calm, wild):
        robot.finish()
    total = assert_nothing_lost(service, [*calm, wild])
    report("robot too fast", scans=total, lost=0, query_s=round(answered_s, 3))
