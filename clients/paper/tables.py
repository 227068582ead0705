"""The paper's tables from the results: markdown for people, the numbers beside it in JSON."""

from collections.abc import Mapping, Sequence
from statistics import fmean, stdev
from typing import Any

from clients.paper.claims import PAPER_TIMES_S, Claim

KEYS = ("auc", "nll", "brier", "ece")
_CUT = ", cut beams"
Results = Mapping[str, Mapping[str, Any]]


def spread(values: Sequence[float]) -> dict[str, float]:
    """Mean and sample standard deviation, 0 of a single value."""
    return {"mean": fmean(values), "std": stdev(values) if len(values) > 1 else 0.0}


def summarise(trials: Sequence[Results]) -> dict[str, Any]:
    """Per map, region and score: mean and spread over the seeds that have the map."""
    names = dict.fromkeys(name for results in trials for name in results)
    return {
        name: {
            region: {
                key: spread([r[name]["scores"][region][key] for r in trials if name in r])
                for key in KEYS
            }
            for region in trials[0][next(iter(trials[0]))]["scores"]
        }
        for name in names
    }


def speed_ratios(trials: Sequence[Results]) -> dict[str, Any]:
    """Per mixture: how many times faster than the single process on the same evidence."""
    ratios: dict[str, Any] = {}
    for name in ("DP", "LT", f"DP{_CUT}", f"LT{_CUT}"):
        base = f"single GP{_CUT}" if name.endswith(_CUT) else "single GP"
        both = [r for r in trials if base in r and name in r]
        if both:
            ratios[name] = {
                "learning": spread([r[base]["learning_s"] / r[name]["learning_s"] for r in both]),
                "inference": spread(
                    [r[base]["inference_s"] / r[name]["inference_s"] for r in both]
                ),
            }
    return ratios


def cost_table(costs: Mapping[str, Any]) -> str:
    """Table 1: measured cost against n and k next to the theory."""
    rows = [
        [what, f"{costs['theory'][what]:+.0f}", f"{costs['powers'][what]:+.2f}"]
        for what in costs["theory"]
    ]
    times = [
        [str(r["n"]), str(r["k"]), _ms(r["learning_s"]), _ms(r["inference_s"])]
        for r in (*costs["by_n"], *costs["by_k"][1:])
    ]
    return (
        "## Table 1: cost\n\nPowers of n (observations) and k (experts).\n\n"
        + _table(["cost", "theory", "measured"], rows)
        + "\n\nOne evaluation of likelihood and gradient; mean and variance at 500 points by all "
        "experts.\n\n" + _table(["n", "k", "learning [ms]", "inference [ms]"], times)
    )


def time_table(trials: Sequence[Results], ratios: Mapping[str, Any]) -> str:
    """Table 2: learning and inference times, processor seconds of this run and ratios."""
    rows = []
    for name in trials[0]:
        if "learning_s" not in trials[0][name]:
            continue
        having = [r[name] for r in trials if name in r]
        learning, inference, clustering = (
            spread([r[key] for r in having])["mean"]
            for key in ("learning_s", "inference_s", "clustering_s")
        )
        ratio = ratios.get(name)
        paper = PAPER_TIMES_S.get(name)
        rows.append(
            [
                name,
                str(having[0].get("clusters", "")),
                str(having[0].get("observations", "")),
                f"{clustering:.3f}",
                f"{learning:.3f}",
                f"{inference:.3f}",
                _times(ratio["learning"]["mean"]) if ratio else "",
                _times(ratio["inference"]["mean"]) if ratio else "",
                _paper_ratios(paper),
            ]
        )
    head = ["method", "clusters", "observations", "clustering [s]", "learning [s]",
            "inference [s]", "learning faster", "inference faster", "in the paper"]  # fmt: skip
    return (
        "## Table 2: times\n\nProcessor time on one core; ratios to the single process on the same "
        "evidence. The paper's times: single GP 11.9 h and 103 s, DP 1.5 h and 17.2 s, LT 1.4 h "
        "and 11.6 s.\n\n" + _table(head, rows)
    )


def _both(score: Mapping[str, float]) -> str:
    """Mean and spread; a single seed has none."""
    mean, std = score["mean"], score["std"]
    return f"{mean:.4f} ± {std:.4f}" if std > 0.0 else f"{mean:.4f}"


def accuracy_table(summary: Mapping[str, Any], region: str, title: str) -> str:
    """Scores of every map over one region."""
    rows = [[name, *(_both(by[region][k]) for k in KEYS)] for name, by in summary.items()]
    return f"## Scores: {title}\n\n" + _table(["map", "AUC", "NLL", "Brier", "ECE"], rows)


def quadrature_table(rules: Mapping[str, Mapping[str, float]]) -> str:
    """What the numerical rules cost and err, on the experts of line tracking."""
    rows = [
        [name, f"{r['gram_error']:.1e}", _ms(r["gram_s"]), f"{r['auc']:.4f}", f"{r['nll']:.4f}"]
        for name, r in rules.items()
    ]
    head = ["rule", "largest error", "all matrices [ms]", "AUC, observed", "NLL, observed"]
    return "## Integral kernels\n\n" + _table(head, rows)


def block_table(facts: Mapping[str, Mapping[str, float]]) -> str:
    """Figure 6 in numbers."""
    rows = [
        [name, f"{f['energy_share']:.3f}", f"{f['area_share']:.3f}", f"{f['merit']:.2f}"]
        for name, f in facts.items()
    ]
    head = ["order", "energy inside blocks", "pairs inside blocks", "ratio"]
    return "## Figure 6: block-diagonality\n\n" + _table(head, rows)


def claim_table(claims: Sequence[Claim]) -> str:
    """What holds and what does not."""
    rows = [["yes" if c.holds else "**no**", c.name, c.found] for c in claims]
    return "## Claims\n\n" + _table(["holds", "claim", "found"], rows)


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.2f}"


def _times(ratio: float) -> str:
    return f"{ratio:.1f} x"


def _paper_ratios(paper: Mapping[str, float] | None) -> str:
    if paper is None:
        return ""
    base = PAPER_TIMES_S["single GP"]
    return ", ".join(_times(base[what] / paper[what]) for what in ("learning", "inference"))
