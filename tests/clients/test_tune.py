"""Tuning: cross-validation over training scans only, and settings that the service can read."""

from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import typer
import yaml
from typer.testing import CliRunner

from clients.map_settings import as_yaml, read_config
from clients.protocol import hit_ends, split
from clients.tune import Outcome, cases_of, measure, search, tune
from gpom_core.config import MapConfig
from gpom_core.errors import ConfigurationError
from tests.clients.rooms import room_log, room_scan

SCANS = [room_scan(index) for index in range(24)]


def outcome(config: MapConfig) -> Outcome:
    """A bowl whose lowest point is at a hit noise of 0.3 and a length scale of 0.25 m."""
    nll = np.log(config.hit_noise_std / 0.3) ** 2 + np.log(config.length_scale_m / 0.25) ** 2
    return Outcome(config, float(nll), 100, 10.0, 50)


def test_held_out_scans_take_no_part() -> None:
    training, held_out = split(SCANS)
    cases = cases_of(SCANS, 3, [Fraction(1), Fraction(1, 3)])
    held_out_hits = {tuple(p) for scan in held_out for p in hit_ends(scan)}
    assert len(cases) == 6
    for case in cases:
        assert all(any(scan is t for t in training) for scan in case.training)
        assert not held_out_hits & {tuple(p) for p in case.test.points}


def test_a_fold_is_never_asked_about_what_built_its_map() -> None:
    for case in cases_of(SCANS, 3, [Fraction(1)]):
        seen = {tuple(p) for scan in case.training for p in hit_ends(scan)}
        assert not seen & {tuple(p) for p in case.test.points[case.test.occupied]}


@pytest.mark.parametrize("folds", [1, 100])
def test_impossible_folds_are_refused(folds: int) -> None:
    with pytest.raises(ConfigurationError, match="fold"):
        cases_of(SCANS, folds, [Fraction(1)])


def test_the_search_finds_the_bottom_of_a_bowl() -> None:
    found = min((o for _, o, better in search(MapConfig(), outcome, 200) if better), key=_nll)
    assert found.config.hit_noise_std == pytest.approx(0.3, rel=0.05)
    assert found.config.length_scale_m == pytest.approx(0.25, rel=0.05)


def test_the_search_keeps_to_its_number_of_trials() -> None:
    assert len(list(search(MapConfig(), outcome, 7))) == 7


def test_a_real_trial_gains_likelihood_and_says_what_it_cost() -> None:
    result = measure(MapConfig(), cases_of(SCANS, 3, [Fraction(1)]))
    assert 0.0 < result.nll < 0.3
    assert result.per_observation == pytest.approx(result.gained / result.observations)
    assert result.training_ms > 0.0


def test_settings_make_the_round_trip_through_the_file(tmp_path: Path) -> None:
    path = tmp_path / "best.yaml"
    config = MapConfig(hit_noise_std=0.33, cell_m=0.12)
    path.write_text(as_yaml(config))
    assert yaml.safe_load(path.read_text()) == {"map": {"cell_m": 0.12, "hit_noise_std": 0.33}}
    assert read_config(path) == config
    assert read_config(None) == MapConfig()


def test_a_file_with_unknown_settings_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text("map: {no_such_setting: 1}")
    with pytest.raises(ConfigurationError, match="no_such_setting"):
        read_config(path)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("map: {cell_m: 0.1}\nmap: {}\n", "has 'map' twice, in lines 1 and 2: make one of them"),
        ("map:\n  cell_m: 0.1\n  cell_m: 0.2\n", "has 'cell_m' twice, in lines 2 and 3"),
        ("map: {cell_m: 2026-13-45}", "holds no settings of a map under the key `map`: month must"),
        ("map: {cell_m: !!bool x}", "holds no settings of a map under the key `map`: 'x'"),
        ("map: {cell_m: \xff}", "holds no settings of a map under the key `map`: 'utf-8'"),
        ("", "has no section `map`; expected the settings of the map under `map:`"),
        ("foo: 1", "has no section `map`; expected the settings of the map under `map:`"),
        ("- 1", "holds no settings; expected `map:` and lines under it"),
        ("map", "holds no settings; expected `map:` and lines under it"),
    ],
)
def test_a_file_that_contradicts_itself_is_refused(
    tmp_path: Path, text: str, expected: str
) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text, encoding="latin-1")
    with pytest.raises(ConfigurationError) as caught:
        read_config(path)
    assert str(caught.value).startswith(f"{path} {expected}")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("map: {foo: 1}", "bad settings in {path}: map.foo: Extra inputs are not permitted, got 1"),
        ("map: [1]", "`map` of {path} is [1]; expected lines `name: value` under it"),
        ("map:", "`map` of {path} is None; expected lines `name: value` under it"),
        ("length_scale_m: 0.3", "length_scale_m stands under `map:`; see {path}"),
        ("map: {}\nhit_cap: 1\ncell_m: 1", "cell_m, hit_cap stand under `map:`; see {path}"),
        ("map: {1: 2}", "bad settings in {path}: map.1: Keys should be strings, got 1"),
    ],
)
def test_settings_stand_under_map_alone(tmp_path: Path, text: str, expected: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(ConfigurationError) as caught:
        read_config(path)
    assert str(caught.value) == expected.format(path=path)


def test_a_missing_file_of_settings_is_said_so(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"cannot read .*none\.yaml: No such file"):
        read_config(tmp_path / "none.yaml")


def test_other_sections_of_the_services_file_are_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "service.yaml"
    path.write_text("http: {port: 80}\nmap: {cell_m: 0.2}\n")
    assert read_config(path) == MapConfig(cell_m=0.2)


def test_what_a_file_merges_is_not_twice(tmp_path: Path) -> None:
    path = tmp_path / "merged.yaml"
    path.write_text("x: &x {cell_m: 0.1, hit_noise_std: 0.3}\nmap: {<<: *x, cell_m: 0.2}\n")
    assert read_config(path) == MapConfig(cell_m=0.2, hit_noise_std=0.3)


def test_the_command_prints_and_writes_the_best(tmp_path: Path) -> None:
    log, out = room_log(tmp_path / "room.log", SCANS), tmp_path / "best.yaml"
    app = typer.Typer()
    app.command()(tune)
    arguments = [str(log), "--folds", "2", "--trials", "2", "--shares", "1", "--output", str(out)]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    assert "best so far" in result.stderr
    assert result.stdout == out.read_text()
    assert read_config(out).length_scale_m > 0.0


def test_a_file_that_cannot_be_written_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("clients.tune.measure", None)  # a first trial would be an error
    log = room_log(tmp_path / "room.log", SCANS)
    with pytest.raises(ConfigurationError, match=r"cannot write .*best\.yaml: No such file"):
        tune([log], folds=2, output=tmp_path / "none" / "best.yaml")


def test_a_log_without_hits_cannot_tune_anything(tmp_path: Path) -> None:
    blind = replace(SCANS[0], ranges_m=np.full(len(SCANS[0].ranges_m), 29.0))
    log = room_log(tmp_path / "blind.log", [blind] * 12)
    with pytest.raises(ConfigurationError, match=r"fold 0 of 2 of .*blind.log have no hit"):
        tune([log], folds=2)


def _nll(result: Outcome) -> float:
    return result.nll
