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


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [
        ("signal_std", 0.01, 100.0),
        ("hit_noise_std", 0.001, 1000.0),
        ("free_noise_std", 0.001, 1000.0),
        ("length_scale_m", 0.0101, 5.0),
    ],
)
def test_scales_that_no_map_has_are_refused(name: str, low: float, high: float) -> None:
    for value in (low, high):
        assert getattr(MapConfig(**{name: value}), name) == value  # type: ignore[arg-type]
    for value in (0.9 * low, 1.1 * high):
        with pytest.raises(ValidationError, match=name):
            MapConfig(**{name: value})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "name", sorted(set(MapConfig.model_fields) - {"free_evidence", "learn_hyperparameters"})
)
def test_true_is_no_number_but_text_may_be_one(name: str) -> None:
    """YAML gives booleans; the environment gives text."""
    with pytest.raises(ValidationError, match=f"expected {name}, not true or false"):
        MapConfig(**{name: True})  # type: ignore[arg-type]
    usual = getattr(MapConfig(), name)
    assert getattr(MapConfig(**{name: str(usual)}), name) == usual  # type: ignore[arg-type]


def test_a_switch_is_true_or_false() -> None:
    assert MapConfig(learn_hyperparameters=True).learn_hyperparameters
    assert MapConfig(learn_hyperparameters="true").learn_hyperparameters  # type: ignore[arg-type]


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


@pytest.mark.parametrize("name", ["hit_noise_std", "free_noise_std"])
def test_noise_is_not_lost_beside_the_signal(name: str) -> None:
    MapConfig(signal_std=100.0, **{name: 0.01})  # type: ignore[arg-type]
    with pytest.raises(ValidationError, match=f"{name} must not be below signal_std / 10000"):
        MapConfig(signal_std=100.0, **{name: 0.009})  # type: ignore[arg-type]


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
