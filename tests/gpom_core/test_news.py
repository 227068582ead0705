"""What is worth learning: little of what a parked robot sees, all that contradicts the map."""

import numpy as np

from gpom_core.config import MapConfig
from gpom_core.mapper import Mapper
from tests.gpom_core.synthetic import look

ALL = 10**6


def test_a_parked_robot_costs_a_bounded_number_of_trainings() -> None:
    mapper = Mapper(MapConfig(hit_cap=10.0, free_cap=10.0, retrain_gain=0.2))
    mapper.update(look(0.3, 0.2, noise=0.02))
    mapper.train()
    last, trainings = 0, 0
    rows = mapper.observation_count
    for i in range(120):
        mapper.update(look(0.3, 0.2, noise=0.02))
        jobs = mapper.take_jobs(ALL)
        mapper.swap([job.run() for job in jobs])
        trainings += len(jobs)
        last = i if jobs else last
    assert mapper.observation_count == rows
    assert trainings < 20 * mapper.expert_count
    assert last < 90


def test_a_parked_robot_trains_less_than_one_expert_a_scan_after_its_first_second() -> None:
    mapper = Mapper()
    for i in range(10):
        mapper.update(look(0.3, 0.2, beams=180, noise=0.01, seed=i))
        mapper.train()
    trainings = 0
    for i in range(10, 300):
        mapper.update(look(0.3, 0.2, beams=180, noise=0.01, seed=i))
        jobs = mapper.take_jobs(ALL)
        mapper.swap([job.run() for job in jobs])
        trainings += len(jobs)
    assert trainings < 290  # noise finds new cells; the rest of the experts stays as it is


def test_a_robot_parked_by_a_long_wall_adds_no_expert_after_its_first_second() -> None:
    wall = [((-12.0, 3.03), (12.0, 3.03))]
    mapper = Mapper()
    for i in range(10):
        mapper.update(look(0.3, 0.2, walls=wall, beams=720, noise=0.01, seed=i, range_max=14.0))
    mapper.train()
    experts, trainings = mapper.expert_count, 0
    for i in range(10, 150):
        mapper.update(look(0.3, 0.2, walls=wall, beams=720, noise=0.01, seed=i, range_max=14.0))
        jobs = mapper.take_jobs(ALL)
        mapper.swap([job.run() for job in jobs])
        trainings += len(jobs)
    assert experts > 8  # the wall is one run of hits, but not one cluster
    assert mapper.expert_count == experts
    assert trainings < 140


def test_what_is_gone_fades_though_every_place_was_known_before() -> None:
    panel = [((1.03, -0.31), (1.03, 0.31))]
    walls = [((2.03, -3.0), (2.03, 3.0))]
    mapper = Mapper()
    for i in range(5):
        mapper.update(look(0.0, 0.0, walls=walls, beams=360, noise=0.01, seed=i))
    mapper.update(look(0.0, 0.0, walls=panel + walls, beams=360, noise=0.01))
    at = np.array([[1.03, 0.0]])
    assert mapper.train().query(at).occupancy[0] > 0.9
    for i in range(400):
        mapper.update(look(0.0, 0.0, walls=walls, beams=360, noise=0.01, seed=i))
        mapper.swap([job.run() for job in mapper.take_jobs(ALL)])
        calibration = mapper.take_calibration()
        if calibration is not None:
            mapper.calibrate(calibration, calibration.run())
    assert mapper.snapshot().query(at).occupancy[0] < 0.1
