"""The online map learns length scales when it is told to, and only then."""

import numpy as np
import pytest

from gpom_core.config import MapConfig
from gpom_core.mapper import Mapper, TrainingJob, length_scale_m
from gpom_core.rows import BOX
from tests.gpom_core.synthetic import tour

LEARNING = MapConfig(learn_hyperparameters=True, learning_budget_s=60.0)


def trained(config: MapConfig) -> Mapper:
    mapper = Mapper(config)
    for scan in tour(6):
        mapper.update(scan)
    mapper.train()
    return mapper


def test_experts_keep_the_settings_unless_told_to_learn():
    config = MapConfig()
    for member in trained(config).snapshot().members.values():
        expert = member.expert
        free = expert.observations.kinds == BOX
        low, high = expert.observations.geometry[free].swapaxes(0, 1)
        cells = (high - low).prod(axis=1).sum() / config.cell_m**2
        often = float(expert.observations.count[free].sum() / cells) if free.any() else 0.0
        assert expert.hyperparameters.length_scale_m == pytest.approx(
            length_scale_m(often, 0.0, config)
        )
        assert expert.hyperparameters.signal_std == config.signal_std


def test_experts_learn_their_own_length_scale_and_share_the_prior():
    experts = trained(LEARNING).snapshot().experts()
    assert len({e.length_scale_m for e in experts}) > 1
    assert {e.signal_std for e in experts} == {LEARNING.signal_std}


def test_a_stronger_pull_stays_closer():
    def distance(spread: float) -> float:
        config = LEARNING.model_copy(update={"learning_spread": spread})
        scales = [e.length_scale_m for e in trained(config).snapshot().experts()]
        return float(np.abs(np.log(np.array(scales) / config.length_scale_m)).mean())

    assert distance(0.02) < distance(0.1) < distance(0.5)


def test_learning_starts_where_it_ended():
    mapper = trained(LEARNING)
    before = {m.cluster_id: m.expert.hyperparameters for m in mapper.snapshot().members.values()}
    for scan in tour(9):
        mapper.update(scan)
    jobs: list[TrainingJob] = mapper.take_jobs(1000)
    again = [job for job in jobs if job.cluster_id in before]
    assert again
    assert all(job.learned_before == before[job.cluster_id] for job in again)


def test_the_map_answers_as_well_with_learned_experts():
    plain, learned = trained(MapConfig()).snapshot(), trained(LEARNING).snapshot()
    points = np.random.default_rng(0).uniform(-3.0, 3.0, (200, 2))
    assert np.abs(plain.query(points).mean - learned.query(points).mean).mean() < 0.1
