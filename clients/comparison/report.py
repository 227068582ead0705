"""A comparison as JSON and as Markdown."""

from collections.abc import Sequence
from dataclasses import asdict

from clients.comparison.places import PLACES
from clients.comparison.study import SCORES, Result, Round, Spread, There
from clients.comparison.targets import verdicts

_HEADING = (
    "Mean of {draws} draws of the held-out test points, ± their standard deviation for AUC and NLL."
)
_ONE_DRAW = "One draw of the held-out test points."
_HEADS = ("AUC", "NLL", "Brier", "ECE", "unknown")
_THERE = ("points a draw", "occupied", "predicted", "AUC", "NLL", "ECE", "unknown")
_COSTS = ("log", "share", "method", "built in, s", "points/s", "MB")


def as_dict(rounds: Sequence[Round], missing: dict[str, str]) -> dict[str, object]:
    """Everything that was measured, ready for JSON."""
    return {
        "places": PLACES,
        "missing": missing,
        "rounds": [
            {
                "log": one.log,
                "share": str(one.share),
                "training_scans": one.training_scans,
                "draws": one.draws,
                "methods": {result.method: _result(result) for result in one.results},
            }
            for one in rounds
        ],
        "targets": [{**asdict(v), "share": str(v.share), "met": v.met} for v in verdicts(rounds)],
    }


def as_markdown(rounds: Sequence[Round], missing: dict[str, str]) -> str:
    """Four tables: the scores, the scores by place, what they cost, and the targets."""
    draws = rounds[0].draws if rounds else 0
    lines = [
        _ONE_DRAW if draws == 1 else _HEADING.format(draws=draws),
        "",
        _row("log", "share", "method", *_HEADS),
        _row(*["---"] * (3 + len(_HEADS))),
    ]
    lines += [
        _row(one.log, str(one.share), result.method, *_cells(result, one.draws))
        for one in rounds
        for result in one.results
    ]
    meaning = "; ".join(f"*{name}*: {what}" for name, what in PLACES.items())
    lines += ["", f"By place, all draws together. {meaning}.", ""]
    lines += [_row("log", "share", "place", "method", *_THERE), _row(*["---"] * (4 + len(_THERE)))]
    lines += [
        _row(one.log, str(one.share), place, result.method, *_there(result.there[place]))
        for one in rounds
        for place in PLACES
        for result in one.results
        if place in result.there
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


def _cells(result: Result, draws: int) -> list[str]:
    s = result.scores
    return [
        _both(s["auc"], draws), _both(s["nll"], draws), f"{s['brier'].mean:.4f}",
        f"{s['ece'].mean:.4f}", f"{s['share_unknown'].mean:.4f}",
    ]  # fmt: skip


def _there(there: There) -> list[str]:
    return [
        f"{there.points:.0f}", f"{there.occupied:.3f}", f"{there.predicted:.3f}",
        "" if there.auc is None else f"{there.auc:.3f}", f"{there.nll:.3f}", f"{there.ece:.3f}",
        f"{there.share_unknown:.3f}",
    ]  # fmt: skip


def _costs(result: Result) -> list[str]:
    """How long building took, with training; answers per second; memory that answering needs."""
    facts = {name: v for name, v in result.facts.items() if isinstance(v, int | float)}
    seconds = facts.get("build_s", 0.0) + facts.get("training_s", 0.0)
    rate = f"{1e6 / facts['query_us']:.2g}" if facts.get("query_us") else ""
    memory = f"{facts['memory_bytes'] / 1e6:.2g}" if "memory_bytes" in facts else ""
    return [f"{seconds:.3g}", rate, memory]


def _both(value: Spread, draws: int) -> str:
    """Mean and spread; one draw has none."""
    return f"{value.mean:.4f} ± {value.std:.4f}" if draws > 1 else f"{value.mean:.4f}"


def _row(*cells: str) -> str:
    return "| " + " | ".join(cells) + " |"


def _result(result: Result) -> dict[str, object]:
    return {
        **result.facts,
        **{name: asdict(result.scores[name]) for name in SCORES},
        "places": {place: asdict(there) for place, there in result.there.items()},
        "reliability": result.reliability.as_dict(),
    }
