"""``gpom paper``: the scene, the methods through one interface, and a small run of all of it."""

import json
from itertools import pairwise

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from clients.paper import command
from clients.paper.claims import Claim, check_claims
from clients.paper.command import paper, require_matplotlib
from clients.paper.costs import measure_costs
from clients.paper.experiment import SENSOR, make_experiment
from clients.paper.methods import GridMethod, paper_methods
from clients.paper.quadratures import Quadrature
from clients.paper.regions import cells_of
from clients.paper.report import Budget
from clients.paper.tables import accuracy_table, summarise
from gpom_core import kernels
from gpom_core.errors import ConfigurationError
from gpom_core.mixture import beams_of

FIGURES = ["fig1_scene", "fig3_clusters", "fig4_experts", "fig5_maps", "fig6_covariances",
           "fig7_roc"]  # fmt: skip
TINY = Budget(seeds=1, resolution_m=1.0, cut_beams=False, sizes=(40, 80), experts=(1, 2), workers=0,
              coarse=True)  # fmt: skip


def run(*arguments):
    app = typer.Typer()
    app.command()(paper)
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result


@pytest.mark.parametrize("seed", range(5))
def test_the_scene_is_close_to_the_papers(seed):
    counts = make_experiment(seed).counts()
    assert counts["poses"] == 26
    assert counts["beams"] == 442
    assert abs(counts["hits"] - 254) <= 15
    assert counts["no_returns"] == 442 - counts["hits"]


def test_seeds_differ_and_repeat():
    first, again, other = (make_experiment(s).scans[3].ranges_m for s in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_robots_keep_off_the_walls_and_scan_every_half_metre():
    experiment = make_experiment(0)
    for robot in experiment.robots:
        places = np.array([scan.pose[:2] for scan in robot.scans])
        assert experiment.world.distance(places).min() > 0.5
        assert max(np.hypot(*(b - a)) for a, b in pairwise(places)) <= 0.5 + 1e-9


def test_regions_follow_what_a_perfect_sensor_sees():
    experiment = make_experiment(0)
    cells = cells_of(experiment, 0.5)
    observed = cells.regions["observed"]
    assert 0.5 < observed.mean() < 0.9
    assert (cells.regions["l_wall"] <= observed).all()
    far = ~np.any(
        [np.hypot(*(cells.points - s.pose[:2]).T) <= SENSOR.range_max_m for s in experiment.scans],
        axis=0,
    )
    assert not observed[far].any()


@pytest.fixture(scope="module")
def maps():
    scans = make_experiment(0).scans[::4]
    return [method.fit(scans) for method in (GridMethod(), *paper_methods(0))]


def test_every_method_answers_the_same_questions(maps):
    beams = beams_of(make_experiment(0).scans[::4])
    hits, passed = beams.end[beams.returned], 0.5 * (beams.origin + beams.end)
    for found in maps:
        assert found.variance(hits).shape == (len(hits),)
        assert found.occupancy(hits).mean() > found.occupancy(passed).mean() + 0.2
        assert {"clustering_s", "learning_s"} <= set(found.costs)


@pytest.mark.parametrize(
    ("rule", "error"),
    [(Quadrature("gauss_legendre"), 1e-9), (Quadrature("simpson", 0.25), 1e-4)],
)
def test_numerical_rules_agree_with_the_exact_kernels(maps, rule, error):
    observations = maps[-1].clusters[0].observations
    kinds, geometry = observations.kinds, observations.geometry
    points = np.random.default_rng(0).uniform(0, 18, (20, 2))
    exact = kernels.gram(kinds, geometry, 0.8)
    assert np.allclose(rule.gram(kinds, geometry, 0.8), exact, rtol=0, atol=error)
    exact = kernels.cross(kinds, geometry, points, 0.8)
    assert np.allclose(rule.cross(kinds, geometry, points, 0.8), exact, rtol=0, atol=error)


def test_costs_grow_with_the_observations():
    costs = measure_costs(make_experiment(0).scans, (100, 400), (1, 4))
    assert costs["powers"]["inference by n"] > 0.3
    assert [row["k"] for row in costs["by_k"]] == [1, 4]


def test_claims_are_held_against_the_means():
    def scores(auc: float, nll: float) -> dict:
        region = {"auc": auc, "nll": nll, "brier": 0.1, "ece": 0.1}
        return {"scores": dict.fromkeys(("observed", "everything", "l_wall"), region)}

    results = {
        "single GP": scores(0.99, 0.3), "DP": scores(0.98, 0.3), "LT": scores(0.99, 0.2),
        **{f"{m} {f}": scores(0.9, 0.5 if f == "poe" else 0.4) for m in ("DP", "LT")
           for f in ("bcm", "poe", "rbcm")},
    }  # fmt: skip
    ratios = {"LT": {"learning": {"mean": 25.0}, "inference": {"mean": 5.0}}}
    holds = {c.name: c.holds for c in check_claims(summarise([results, results]), ratios)}
    assert sum(holds.values()) == len(holds) - 2
    assert not next(v for k, v in holds.items() if k.startswith("DP is not more"))
    assert not next(v for k, v in holds.items() if "inference" in k)


@pytest.mark.slow
def test_the_command_writes_every_figure_and_table(tmp_path, monkeypatch):
    monkeypatch.setattr("clients.paper.report.QUICK", TINY)
    run("--output", str(tmp_path / "out"), "--quick", "--workers", "0")
    for name in FIGURES:
        assert (tmp_path / "out" / f"{name}.png").read_bytes()[:4] == b"\x89PNG"
    tables = (tmp_path / "out" / "tables.md").read_text()
    assert "Table 1" in tables
    assert "Table 2" in tables
    assert "too coarse for the claims on speed" in tables
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert {"claims", "table1", "quadratures", "fig6", "summary", "speed_ratios"} <= set(results)
    for name in ("grid", "single GP", "DP", "LT", "LT rbcm"):
        assert results["summary"][name]["observed"]["auc"]["mean"] > 0.5


@pytest.mark.parametrize(
    ("arguments", "seeds", "coarse"),
    [([], 5, False), (["--seeds", "3"], 3, False), (["--quick"], 2, True),
     (["--quick", "--seeds", "1"], 1, True)],
)  # fmt: skip
def test_a_quick_run_takes_the_seeds_and_says_that_it_is_coarse(
    tmp_path, monkeypatch, arguments, seeds, coarse
):
    def reproduce(folder, budget, _say):
        assert folder.is_dir()
        assert budget.seeds == seeds
        return {"duration_s": 0.0}, [Claim("LT: learning is faster", False, "1 time")]

    monkeypatch.setattr("clients.paper.report.reproduce", reproduce)
    result = run("--output", str(tmp_path / "out"), *arguments)
    assert ("too coarse for the claims on speed" in " ".join(result.stderr.split())) == coarse


def test_a_folder_that_cannot_be_made_is_refused_before_the_work(tmp_path, monkeypatch):
    monkeypatch.setattr("clients.paper.report.reproduce", None)
    (tmp_path / "file").touch()
    with pytest.raises(ConfigurationError, match="file is a file; expected a folder"):
        paper(output=tmp_path / "file")


def test_a_single_seed_has_no_spread():
    scores = {"scores": {"observed": dict.fromkeys(("auc", "nll", "brier", "ece"), 0.25)}}
    other = {"scores": {"observed": dict.fromkeys(("auc", "nll", "brier", "ece"), 0.75)}}
    summary = summarise([{"DP": scores, "LT": scores}, {"DP": other}])
    table = accuracy_table(summary, "observed", "here")
    assert "| DP | 0.5000 ± 0.3536 |" in table
    assert "| LT | 0.2500 | 0.2500 |" in table


def test_says_what_to_install_without_matplotlib(monkeypatch):
    monkeypatch.setattr(command, "find_spec", lambda name: None)
    with pytest.raises(ConfigurationError, match=r"gpom\[paper\]"):
        require_matplotlib()
