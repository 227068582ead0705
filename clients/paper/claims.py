"""What the paper claims and what is asked of this reproduction, held against the numbers."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

AUC_MARGIN = 0.005
LEARNING_RATIO = 20.0
INFERENCE_RATIO = 10.0

PAPER_TIMES_S = {
    "single GP": {"learning": 11.9 * 3600, "inference": 103.0},
    "DP": {"learning": 1.5 * 3600, "inference": 17.2},
    "LT": {"learning": 1.4 * 3600, "inference": 11.6},
}
"""Table 2 of the paper."""


@dataclass(frozen=True, slots=True)
class Claim:
    """One claim and whether it holds here.

    Attributes:
        found: the numbers, for people.
    """

    name: str
    holds: bool
    found: str

    def as_dict(self) -> dict[str, object]:
        """Ready for JSON."""
        return {"claim": self.name, "holds": self.holds, "found": self.found}


def check_claims(summary: Mapping[str, Any], ratios: Mapping[str, Any]) -> list[Claim]:
    """Hold the means over all seeds against every claim.

    Args:
        summary: per map, region and score, `mean` and `std`.
        ratios: per mixture, how many times faster than the single process.
    """

    def mean(name: str, region: str, key: str) -> float:
        return float(summary[name][region][key]["mean"])

    claims = []
    base = mean("single GP", "observed", "auc")
    for name in ("DP", "LT"):
        found = mean(name, "observed", "auc")
        claims.append(
            Claim(
                f"{name} is not more than {AUC_MARGIN} AUC below the single GP, observed area",
                found >= base - AUC_MARGIN,
                f"{found:.4f} against {base:.4f}",
            )
        )
    for key, sign in (("auc", 1.0), ("nll", -1.0)):
        lt, dp = mean("LT", "l_wall", key), mean("DP", "l_wall", key)
        claims.append(
            Claim(
                f"LT is not worse than DP on the L-shaped wall, by {key.upper()}",
                sign * lt >= sign * dp,
                f"{lt:.4f} against {dp:.4f}",
            )
        )
    for name in ("DP", "LT", "DP, cut beams", "LT, cut beams"):
        if name not in summary:
            continue
        for region in ("observed", "everything"):
            bcm, poe, rbcm = (mean(f"{name} {f}", region, "nll") for f in ("bcm", "poe", "rbcm"))
            claims.append(
                Claim(
                    f"{name}: bcm's NLL is not worse than poe's (eq. 13 as printed), {region}",
                    bcm <= poe,
                    f"bcm {bcm:.3f}, poe {poe:.3f}, rbcm {rbcm:.3f}",
                )
            )
    for what, least in (("learning", LEARNING_RATIO), ("inference", INFERENCE_RATIO)):
        ours = float(ratios["LT"][what]["mean"])
        paper = PAPER_TIMES_S["single GP"][what] / PAPER_TIMES_S["LT"][what]
        claims.append(
            Claim(
                f"LT: {what} is at least {least:g} times faster than with the single GP",
                ours >= least,
                f"{ours:.1f} times; the paper {paper:.1f}",
            )
        )
    return claims
