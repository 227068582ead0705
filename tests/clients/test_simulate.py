"""The simulated building, its scanner and the robots in it."""

from itertools import islice, pairwise
from math import inf, nan, pi

import numpy as np
import pytest

from clients.building import furnished_building
from clients.sensor import RangeSensor
from clients.simulate import ROBOT_RADIUS_M, RobotSimulator
from clients.world import Box, World
from gpom_core.errors import ConfigurationError
from gpom_core.scan import Pose2D

EXACT = RangeSensor(noise_std_m=0.0, dropout_probability=0.0)


@pytest.fixture(scope="module")
def site():
    return furnished_building(seed=3)


def hit_ends(scan):
    angles, hits = scan.beam_angles_rad(), scan.hits()
    ways = scan.ranges_m[hits, None] * np.column_stack([np.cos(angles), np.sin(angles)])[hits]
    return np.array(scan.pose[:2]) + ways


@pytest.mark.parametrize("seed", range(8))
def test_furniture_leaves_every_way_clear(seed):
    site = furnished_building(seed)
    share = np.linspace(0.0, 1.0, 80)[:, None, None]
    ways = site.nodes[site.edges]
    points = (ways[:, 0] * (1 - share) + ways[:, 1] * share).reshape(-1, 2)
    # A rounded corner leaves its way by 0.25 m at most.
    assert site.world.distance(points).min() >= ROBOT_RADIUS_M + 0.25


def test_every_room_is_reached_from_every_other(site):
    corners = [corner for room in site.rooms for corner in room]
    for goal in corners:
        route = site.route(corners[0], goal)
        assert (route[0], route[-1]) == (corners[0], goal)
        edges = {frozenset(edge) for edge in site.edges.tolist()}
        assert all(frozenset(pair) in edges for pair in pairwise(route))


def test_the_building_is_closed_and_as_large_as_said(site):
    assert site.world.bounds_m == pytest.approx((-0.1, -0.1, 30.1, 20.1))
    for place in site.nodes:
        assert np.isfinite(site.world.cast(place, np.linspace(-pi, pi, 720))).all()


def test_seeds_furnish_differently_and_the_same():
    first, again, other = (furnished_building(seed).world.boxes for seed in (1, 1, 2))
    assert first == again
    assert first != other


@pytest.mark.parametrize("robot", range(7))
def test_robots_never_touch_anything(site, robot):
    # A scanner of two beams, since only the poses matter.
    simulator = RobotSimulator(site, RangeSensor(beams=2), robot=robot, rate_hz=5.0)
    poses = np.array([scan.pose for scan in simulator.scans(300.0)])
    assert site.world.distance(poses[:, :2]).min() > ROBOT_RADIUS_M
    steps = np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)
    assert steps.max() <= 0.8 / 5.0 + 1e-9
    assert np.abs(np.diff(poses[:, 2])).max() <= 1.5 / 5.0 + 1e-9


def test_a_tour_sees_every_room(site):
    simulator = RobotSimulator(site, RangeSensor(beams=2), rate_hz=2.0)
    poses = np.array([scan.pose[:2] for scan in simulator.scans(1200.0)])
    for room in site.rooms:
        for corner in site.nodes[list(room)]:
            assert np.linalg.norm(poses - corner, axis=1).min() < 0.6


def test_scans_are_the_same_for_the_same_seed(site):
    def ranges(seed, robot):
        scans = islice(RobotSimulator(site, seed=seed, robot=robot).scans(), 20)
        return np.array([scan.ranges_m for scan in scans])

    np.testing.assert_array_equal(ranges(1, 0), ranges(1, 0))
    assert not np.array_equal(ranges(1, 0), ranges(2, 0), equal_nan=True)
    assert not np.array_equal(ranges(1, 0), ranges(1, 1), equal_nan=True)


def test_duration_rate_and_stamps(site):
    simulator = RobotSimulator(site, EXACT, rate_hz=4.0, start_ns=1000)
    scans = list(simulator.scans(2.5))
    assert [scan.stamp_ns for scan in scans] == [1000 + 250_000_000 * i for i in range(10)]
    assert scans[0].scan_time_s == 0.25
    assert list(simulator.scans(0.0)) == []


def test_hits_lie_on_surfaces_and_beams_in_free_space(site):
    for scan in RobotSimulator(site, EXACT, rate_hz=0.5).scans(60.0):
        assert np.abs(site.world.distance(hit_ends(scan))).max() < 1e-4
        angles = scan.beam_angles_rad()
        halfway = np.where(scan.hits(), scan.ranges_m, scan.range_max_m) / 2
        points = np.array(scan.pose[:2]) + halfway[:, None] * np.column_stack(
            [np.cos(angles), np.sin(angles)]
        )
        assert not site.world.is_occupied(points).any()


def measure(sensor, count=200):
    world = World([Box(3.0, 0.0, 2.0, 400.0)])  # a wall 2 m ahead
    rng = np.random.default_rng(0)
    return np.array([sensor.measure(world, Pose2D(0.0, 0.0, 0.0), rng) for _ in range(count)])


def test_noise_dropouts_and_missed_echoes_come_as_often_as_asked():
    sensor = RangeSensor(
        beams=31, fov_rad=1.0, noise_std_m=0.05, dropout_probability=0.1, missed_probability=0.2
    )
    ranges = measure(sensor, 1000)
    assert np.isnan(ranges).mean() == pytest.approx(0.1, abs=0.01)
    assert np.isposinf(ranges).mean() == pytest.approx(0.18, abs=0.01)
    ahead = ranges[:, 15]
    ahead = ahead[np.isfinite(ahead)]
    assert ahead.mean() == pytest.approx(2.0, abs=0.01)
    assert ahead.std() == pytest.approx(0.05, abs=0.005)


def test_limits_of_the_range():
    far = measure(RangeSensor(beams=3, fov_rad=1.0, range_max_m=1.5, dropout_probability=0.0))
    assert np.isposinf(far).all()
    near = measure(
        RangeSensor(beams=3, fov_rad=1.0, range_min_m=2.5, range_max_m=3.0, dropout_probability=0.0)
    )
    assert np.isneginf(near).all()


def test_a_full_circle_has_no_beam_twice():
    full = RangeSensor(beams=360)
    assert full.angle_increment_rad * 360 == pytest.approx(2 * pi)
    half = RangeSensor(beams=181, fov_rad=pi)
    assert half.angle_min_rad + 180 * half.angle_increment_rad == pytest.approx(pi / 2)


@pytest.mark.parametrize(
    "fields",
    [
        {"beams": 1},
        {"fov_rad": 0.0},
        {"fov_rad": 7.0},
        {"range_min_m": -1.0},
        {"range_max_m": 0.01},
        {"range_max_m": inf},
        {"noise_std_m": nan},
        {"dropout_probability": 1.5},
        {"missed_probability": -0.1},
    ],
)
def test_refuses_impossible_scanners(fields):
    with pytest.raises(ConfigurationError, match="impossible"):
        RangeSensor(**fields)


@pytest.mark.parametrize("name", ["rate_hz", "speed_m_s", "turn_rate_rad_s"])
@pytest.mark.parametrize("value", [0.0, -1.0, inf, nan])
def test_refuses_impossible_robots(site, name, value):
    with pytest.raises(ConfigurationError, match=name):
        RobotSimulator(site, **{name: value})
