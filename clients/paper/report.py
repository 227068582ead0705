"""The whole reproduction: trials over seeds, costs, quadratures, figures, tables, JSON."""

import json
import os
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from time import monotonic
from typing import Any

from clients.paper.claims import Claim, check_claims
from clients.paper.costs import EXPERTS, SIZES, measure_costs
from clients.paper.figures import draw_figures
from clients.paper.methods import GridMethod, Method, MixtureMap, paper_methods
from clients.paper.quadratures import compare_rules
from clients.paper.regions import cells_of
from clients.paper.tables import (
    accuracy_table,
    block_table,
    claim_table,
    cost_table,
    quadrature_table,
    speed_ratios,
    summarise,
    time_table,
)
from clients.paper.trials import methods_of, run_trial, warm_up

Progress = Callable[[str], None]

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_RULES_RESOLUTION_M = 0.2


@dataclass(frozen=True, slots=True)
class Budget:
    """How much to compute.

    Attributes:
        seeds: number of experiments.
        resolution_m: of the cells that are scored and drawn.
        cut_beams: also maps of bounded segments.
        sizes, experts: of table 1.
        workers: processes; 0 for none but this one.
        coarse: too much so for the claims on speed, which the report says.
    """

    seeds: int = 5
    resolution_m: float = 0.1
    cut_beams: bool = True
    sizes: tuple[int, ...] = SIZES
    experts: tuple[int, ...] = EXPERTS
    workers: int = 2
    coarse: bool = False


QUICK = Budget(
    seeds=2, resolution_m=0.4, cut_beams=False, sizes=(100, 200, 400), experts=(1, 2, 4, 8),
    coarse=True,
)  # fmt: skip
COARSE = (
    "This was a quick run: too coarse for the claims on speed, and of few cells for those on "
    "scores. Judge them by a run without --quick."
)


def reproduce(folder: Path, budget: Budget, say: Progress) -> tuple[dict[str, Any], list[Claim]]:
    """Compute everything, and write figures, `tables.md` and `results.json` to a folder.

    The folder is there already.
    """
    started = monotonic()
    trials: dict[int, dict[str, Any]] = {}
    extra: dict[str, Any] = {}
    with _pool(budget.workers) as submit:
        jobs = {
            submit(one_seed, seed, budget, folder if seed == 0 else None): seed
            for seed in range(budget.seeds)
        }
        for job in as_completed(jobs):
            seed = jobs[job]
            trials[seed], found = job.result()
            extra |= found
            say(f"seed {seed}: {len(trials[seed])} maps scored")
    in_order = [trials[seed] for seed in sorted(trials)]
    summary, ratios = summarise(in_order), speed_ratios(in_order)
    claims = check_claims(summary, ratios)
    results = {
        "duration_s": monotonic() - started,
        "seeds": budget.seeds,
        "resolution_m": budget.resolution_m,
        "coarse": budget.coarse,
        **extra,
        "claims": [claim.as_dict() for claim in claims],
        "speed_ratios": ratios,
        "summary": summary,
        "trials": in_order,
    }
    (folder / "tables.md").write_text(_tables(results, claims))
    (folder / "results.json").write_text(json.dumps(results, indent=1))
    return results, claims


def one_seed(
    seed: int, budget: Budget, folder: Path | None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Run one seed; with a folder also what is done once: figures, costs, quadratures."""
    warm_up()
    methods: list[Method] = [GridMethod(), *paper_methods(seed)]
    if budget.cut_beams:
        methods = methods_of(seed, first=seed == 0)
    trial = run_trial(seed, methods, budget.resolution_m, lambda _: None)
    results: dict[str, Any] = dict(trial.results)
    if folder is None:
        return results, {}
    extra: dict[str, Any] = {"experiment": trial.experiment.counts()}
    extra["table1"] = measure_costs(trial.experiment.scans, budget.sizes, budget.experts)
    lt = trial.maps["LT"]
    if isinstance(lt, MixtureMap):
        cells = cells_of(trial.experiment, max(_RULES_RESOLUTION_M, budget.resolution_m))
        extra["quadratures"] = compare_rules(lt, cells)
    return results, extra | draw_figures(trial, folder)


@contextmanager
def _pool(workers: int) -> Iterator[Callable[..., "Future[Any]"]]:
    """Processes with one thread per maths library, as every figure of speed here assumes."""
    if workers == 0:
        yield _at_once
        return
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))  # read when numpy is imported
    try:
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            yield pool.submit
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _at_once(work: Callable[..., Any], *arguments: Any) -> "Future[Any]":
    done: Future[Any] = Future()
    done.set_result(work(*arguments))
    return done


def _tables(results: Mapping[str, Any], claims: list[Claim]) -> str:
    counts = ", ".join(f"{value} {name}" for name, value in results["experiment"].items())
    about = (
        f"Seed 0: {counts} (the paper: 26 poses, 442 beams, 254 hits, 188 no-returns, 696 "
        f"observations). {results['seeds']} seeds, cells of {results['resolution_m']} m, "
        f"{results['duration_s']:.0f} s in all. Scores are means over seeds, ± standard deviations "
        "where there are several; a suffix names the fusion rule, none means bcm. Cut beams are "
        "cut into pieces of 2 m."
    )
    parts = [
        "# The paper's experiment",
        about,
        claim_table(claims),
        *([COARSE] if results["coarse"] else []),
        cost_table(results["table1"]),
        time_table(results["trials"], results["speed_ratios"]),
        accuracy_table(results["summary"], "observed", "the observed area"),
        accuracy_table(results["summary"], "everything", "everything"),
        accuracy_table(results["summary"], "l_wall", "within 1 m of the L-shaped wall"),
        quadrature_table(results["quadratures"]),
        block_table(results["fig6"]),
    ]
    return "\n\n".join(parts) + "\n"
