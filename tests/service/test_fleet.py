from math import tau

import pytest

from gpom_core.scan import Pose2D
from service.fleet import Fleet, RobotStatus

POSE = Pose2D(1.0, 2.0, 0.5)


def test_scans_add_up() -> None:
    fleet = Fleet(10)
    assert fleet.saw_scan("b", POSE, 2, 100.0) is not None, "the first scan is news"
    assert fleet.saw_scan("b", POSE, 1, 101.0) is None
    fleet.saw_scan("a", POSE, 0, 99.0)
    assert [robot.id for robot in fleet.robots()] == ["a", "b"]
    assert fleet.robots()[1] == RobotStatus("b", 2, 3, 101.0, POSE, alive=False)


def test_headings_are_within_half_a_turn() -> None:
    fleet = Fleet(10)
    fleet.saw_scan("a", Pose2D(1.0, 2.0, 31.4), 0, 1.0)
    assert fleet.robots()[0].pose == pytest.approx((1.0, 2.0, 31.4 - 5 * tau))


def test_refusals_add_up_by_reason_for_robots_that_are_known() -> None:
    fleet = Fleet(10)
    fleet.refused_scans("stranger", "bad_crc")
    fleet.saw_scan("a", POSE, 0, 1.0)
    fleet.refused_scans("a", "stale", 2)
    fleet.refused_scans("a", "stale")
    fleet.refused_scans("a", "bad_crc")
    (robot,) = fleet.robots()
    assert (robot.scans, robot.refused) == (1, {"stale": 3, "bad_crc": 1})


def test_of_too_many_the_robots_seen_last_are_remembered() -> None:
    fleet = Fleet(2)
    seen = {"a": 5.0, "b": 1.0, "c": 3.0}
    fleet.restore([RobotStatus(name, 1, 0, unix_s, POSE) for name, unix_s in seen.items()])
    assert [robot.id for robot in fleet.robots()] == ["a", "c"]


def test_presence_is_news_only_when_it_changes() -> None:
    fleet = Fleet(10)
    assert fleet.set_alive("a", False) is None, "nobody goes who never came"
    assert fleet.set_alive("a", True) == RobotStatus("a", alive=True)
    assert fleet.set_alive("a", True) is None
    assert fleet.set_alive("a", False) == RobotStatus("a")


def test_only_so_many_robots_are_remembered() -> None:
    fleet = Fleet(1)
    fleet.set_alive("a", True)
    assert fleet.set_alive("b", True) is None
    assert fleet.has_room("a")
    assert not fleet.has_room("b")
