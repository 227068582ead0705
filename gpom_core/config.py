"""Settings of the map. Units are in the names; unknown keys are refused."""

from __future__ import annotations

from typing import Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)

FREE_TO_CHANGE = frozenset(
    {
        "max_observations",
        "retrain_gain",
        "learn_hyperparameters",
        "learning_spread",
        "learning_evaluations",
        "learning_budget_s",
        "known_variance_ratio",
    }
)
"""Settings under which a saved map may go on with another value: they say when and how long experts
are trained from now on, and what is called known. All others say what evidence is and means."""


SIGNAL_RATIO_MAX = 1e4
"""Of the prior's standard deviation to that of an observation; beyond it float64 is too coarse."""


class MapConfig(BaseModel):
    """Everything that shapes the map. `MapConfig()` is a good map of a building.

    Raises:
        pydantic.ValidationError: a value is out of range or a key is unknown.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    # Evidence
    free_evidence: Literal["areas", "segments"] = "areas"
    cell_m: float = Field(0.1, gt=0.01, le=1.0, description="edge of a free area")
    hit_cell_m: float = Field(0.05, gt=0.005, le=1.0, description="hits closer than this merge")
    segment_m: float = Field(0.5, gt=0.05, le=2.0, description="longest free segment")
    coarse_levels: int = Field(3, ge=0, le=6, description="free areas merge up to cell_m * 2^this")
    coarsen_ratio: float = Field(
        3.0, ge=0.0, description="they merge where the nearest hit is farther than this many edges"
    )
    hit_margin_m: float = Field(0.1, ge=0.0, le=1.0, description="not called free before a hit")
    max_range_m: float = Field(30.0, gt=0.0, le=300.0, description="beams are cut here")
    hit_noise_std: float = Field(
        0.42, ge=0.001, le=1000.0, description="of one hit, in units of the target"
    )
    free_noise_std: float = Field(2.5, ge=0.001, le=1000.0, description="of one traversal")
    hit_cap: float = Field(100.0, ge=1.0, description="evidence of a place never counts more")
    free_cap: float = Field(1000.0, ge=1.0)

    # Clusters
    line_tolerance_m: float = Field(0.1, gt=0.0, description="distance of a hit from its line")
    line_gap_m: float = Field(0.3, gt=0.0, description="longest gap between hits of a line")
    max_length_m: float = Field(3.0, gt=0.1, description="a longer cluster is split")
    max_observations: int = Field(160, ge=16, description="a larger expert is split")
    retrain_gain: float = Field(
        0.1, gt=0.0, description="an expert is dirty when the means at its places moved this much"
    )
    near_surface_m: float = Field(
        2.4, ge=0.0, le=20.0, description="free areas this near belong to the nearest hit's cluster"
    )

    # Experts
    length_scale_m: float = Field(
        0.2,
        gt=0.01,
        le=5.0,
        description="where a cell was crossed five times; more often less, and v.v.",
    )
    signal_std: float = Field(1.0, ge=0.01, le=100.0)
    learn_hyperparameters: bool = Field(
        False, description="the length scale of each expert, by marginal likelihood"
    )
    learning_spread: float = Field(
        0.1, gt=0.0, description="of learned length scales around length_scale_m, in logarithms"
    )
    learning_evaluations: int = Field(15, ge=1, description="of the likelihood, per training")
    learning_budget_s: float = Field(1.0, gt=0.0, description="per training of one expert")

    # Answers
    known_variance_ratio: float = Field(
        0.8, gt=0.0, lt=1.0, description="below this share of the prior variance a point is known"
    )

    def clash(self, other: MapConfig) -> dict[str, object]:
        """Settings of another map that keep it from going on with these, with their values."""
        return {
            name: theirs
            for name, theirs in other
            if theirs != getattr(self, name) and name not in FREE_TO_CHANGE
        }

    @field_validator("*", mode="before")
    @classmethod
    def _no_switch(cls, value: object, info: ValidationInfo) -> object:
        """Pydantic takes `true` for 1."""
        name = info.field_name or ""
        if isinstance(value, bool) and cls.model_fields[name].annotation is not bool:
            raise ValueError(f"expected {name}, not true or false")
        return value

    @model_validator(mode="after")
    def _fits_together(self) -> MapConfig:
        if self.hit_cell_m > self.cell_m:
            raise ValueError("hit_cell_m must not exceed cell_m: a hit belongs to one free area")
        for name in ("hit_noise_std", "free_noise_std"):
            if getattr(self, name) < self.signal_std / SIGNAL_RATIO_MAX:
                raise ValueError(
                    f"{name} must not be below signal_std / {SIGNAL_RATIO_MAX:g}: "
                    "covariances would be singular"
                )
        return self
