"""The configuration validates and never repairs."""

import pytest
from pydantic import ValidationError

from gpom_core.config import FREE_TO_CHANGE, MapConfig


@pytest.mark.parametrize(
    "name", sorted(set(MapConfig.model_fields) - {"free_evidence", "learn_hyperparameters"})
)
@pytest.mark.parametrize("value", [-1.0, float("nan"), float("inf"), "much", None])
def test_values_out_of_range_are_refused(name: str, value: object) -> None:
    with pytest.raises(ValidationError, match=name):
        MapConfig(**{name: value})  # type: ignore[arg-type]


def test_unknown_settings_are_refused() -> None:
    with pytest.raises(ValidationError, match="cell_size"):
        MapConfig(cell_size=0.1)  # type: ignore[call-arg]


def test_free_evidence_is_areas_or_segments() -> None:
    assert MapConfig(free_evidence="segments").free_evidence == "segments"
    with pytest.raises(ValidationError, match="free_evidence"):
        MapConfig(free_evidence="beams")  # type: ignore[arg-type]


def test_a_hit_belongs_to_one_free_area() -> None:
    with pytest.raises(ValidationError, match="hit_cell_m must not exceed cell_m"):
        MapConfig(cell_m=0.1, hit_cell_m=0.2)


def test_a_configuration_does_not_change() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        MapConfig().cell_m = 0.2  # type: ignore[misc]


def test_a_configuration_survives_being_written_and_read() -> None:
    config = MapConfig(cell_m=0.2, free_evidence="segments")
    assert MapConfig.model_validate_json(config.model_dump_json()) == config


def test_settings_that_change_what_evidence_means_clash() -> None:
    ours = MapConfig()
    free = {"retrain_gain": 0.7, "max_observations": 99, "known_variance_ratio": 0.5}
    assert ours.clash(MapConfig(**free)) == {}
    theirs = MapConfig(cell_m=0.2, hit_cap=7.0, **free)
    assert ours.clash(theirs) == {"cell_m": 0.2, "hit_cap": 7.0}
    assert set(MapConfig.model_fields) > FREE_TO_CHANGE
