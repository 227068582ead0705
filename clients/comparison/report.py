"""A comparison as JSON and as Markdown."""

from collections.abc import Sequence
from dataclasses import asdict

from clients.comparison.study import FAR_M, SCORES, Result, Round, Spread
from clients.comparison.targets import verdicts

_HEADING = (
    "Mean of {draws} draws of the held-out test points, ± their standard deviation for AUC and "
    "NLL. Far: NLL at points more than {far_m:g} m from every training beam."
)
_HEADS = ("AUC", "NLL", "Brier", "ECE", "unknown")
_COSTS = ("log", "share", "method", "built in, s", "points/s", "MB")


def as_dict(rounds: Sequence[Round], missing: dict[str, str]) -> dict[str, object]:
    """Everything that was measured, ready for JSON."""
    return {
        "far_m": FAR_M,
        "missing": missing,
        "rounds": [
            {
                "log": one.log,
                "share": str(one.share),
                "training_scans": one.training_scans,
                "draws": one.draws,
                "far_points": one.far_points,
                "methods": {result.method: _result(result) for result in one.results},
            }
            for one in rounds
        ],
        "targets": [{**asdict(v), "share": str(v.share), "met": v.met} for v in verdicts(rounds)],
    }


def as_markdown(rounds: Sequence[Round], missing: dict[str, str]) -> str:
    """Three tables: the scores, what they cost, and the targets."""
    lines = [
        _HEADING.format(draws=rounds[0].draws if rounds else 0, far_m=FAR_M),
        "",
        _row("log", "share", "method", *_HEADS, "far NLL"),
        _row(*["---"] * 9),
    ]
    lines += [
        _row(one.log, str(one.share), result.method, *_cells(result))
        for one in rounds
        for result in one.results
    ]
    lines += ["", _row(*_COSTS), _row(*["---"] * len(_COSTS))]
    lines += [
        _row(one.log, str(one.share), result.method, *_costs(result))
        for one in rounds
        for result in one.results
    ]
    lines += [f"\n{name} took no part: install {package}." for name, package in missing.items()]
    lines += [
        "",
        _row("log", "share", "target", "value", "at most", "met", "against the tuned grid"),
        _row(*["---"] * 7),
    ]
    for v in verdicts(rounds):
        tuned = "" if v.against_tuned is None else f"{v.against_tuned:.4f}"
        met = "yes" if v.met else "**no**"
        lines.append(
            _row(v.log, str(v.share), v.what, f"{v.value:.4f}", f"{v.limit:g}", met, tuned)
        )
    return "\n".join(lines) + "\n"


def _cells(result: Result) -> list[str]:
    s = result.scores
    far = "" if result.far is None else _both(result.far["nll"], 3)
    return [
        _both(s["auc"], 4), _both(s["nll"], 4), f"{s['brier'].mean:.4f}",
        f"{s['ece'].mean:.4f}", f"{s['share_unknown'].mean:.4f}", far,
    ]  # fmt: skip


def _costs(result: Result) -> list[str]:
    """How long building took, with training; answers per second; memory that answering needs."""
    facts = {name: v for name, v in result.facts.items() if isinstance(v, int | float)}
    seconds = facts.get("build_s", 0.0) + facts.get("training_s", 0.0)
    rate = f"{1e6 / facts['query_us']:.2g}" if facts.get("query_us") else ""
    memory = f"{facts['memory_bytes'] / 1e6:.2g}" if "memory_bytes" in facts else ""
    return [f"{seconds:.3g}", rate, memory]


def _both(value: Spread, digits: int) -> str:
    return f"{value.mean:.{digits}f} ± {value.std:.{digits}f}"


def _row(*cells: str) -> str:
    return "| " + " | ".join(cells) + " |"


def _result(result: Result) -> dict[str, object]:
    far = result.far
    return {
        **result.facts,
        **{name: asdict(result.scores[name]) for name in SCORES},
        "far": None if far is None else {name: asdict(far[name]) for name in SCORES},
        "reliability": result.reliability.as_dict(),
    }
