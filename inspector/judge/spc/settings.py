"""Settings of the statistics, and the plant's table of advisory actions."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import Field, PositiveFloat, model_validator

from firmware_bridge.strict import Strict


class Target(Strict):
    """The rate of defects that the plant expects of a recipe, in place of one learnt from its first panels."""

    recipe: int | None = Field(None, ge=1, le=65535)
    """Id of the recipe; null: every one that has no target of its own."""
    per_m2: PositiveFloat
    """Defects per square metre."""
    sigma_z: float = Field(1.0, ge=1, le=100)
    """By how much counts scatter more than Poisson's law lets them (Laney's sigma z); 1: no more."""


ActionName = Literal[
    "HOLD", "CHECK_FILTER", "CLEAN_BOOTH", "CHECK_FIXTURE", "CHECK_PAINT", "CHECK_LAMP", "CHECK_STATION", "WATCH"
]
RuleName = Literal[
    "CUSUM_ABOVE",
    "EWMA_ABOVE",
    "COUNT_ABOVE",
    "REPEATED_PLACE",
    "HEIGHT_ABOVE",
    "HEIGHT_BELOW",
    "HEIGHT_PATTERN",
    "COUNT_BELOW",
    "CUSUM_BELOW",
    "EWMA_BELOW",
]


class When(Strict):
    """Conditions of a row; all that are given must hold, and one on a statistic that is not known does not."""

    rules: tuple[RuleName, ...] = ()
    """The alarm's rule is one of these; empty: no matter which, nor whether there is an alarm."""
    spread: tuple[Literal["RANDOM", "CLUSTERED", "EVEN"], ...] = ()
    """How defects lie is one of these."""
    trend: tuple[Literal["STEADY", "RISING", "FALLING"], ...] = ()
    """Where their rate goes is one of these."""
    min_ratio: PositiveFloat | None = None
    """Recent defects over those of the baseline are at least this."""
    max_ratio: PositiveFloat | None = None
    """They are at most this."""
    min_large_share: float | None = Field(None, ge=0, le=1)
    """At least this share of recent heights is above large_um."""
    max_large_share: float | None = Field(None, ge=0, le=1)
    """At most this share is."""
    min_not_inspected_share: float | None = Field(None, gt=0, le=1)
    """At least this share of recent panels was not inspected; only such rows hold after a panel that was not."""

    @model_validator(mode="after")
    def _asks_something(self) -> Self:
        if not self.model_fields_set:
            raise ValueError("needs at least one condition: a row that always holds would hide those below it")
        return self


class ActionRow(Strict):
    """One row of the table."""

    when: When
    """Conditions, all of which must hold."""
    action: ActionName | Annotated[int, Field(ge=100, le=65534)]
    """What to advise: one of the names, or a number of the plant's own from 100."""
    confidence: float = Field(gt=0, le=1)
    """How sure this advice is when the conditions hold, 0 to 1."""
    text: str = Field(min_length=1, max_length=200)
    """The advice in words."""


RISES: tuple[RuleName, ...] = ("CUSUM_ABOVE", "EWMA_ABOVE", "COUNT_ABOVE")
FALLS: tuple[RuleName, ...] = ("COUNT_BELOW", "CUSUM_BELOW", "EWMA_BELOW")

DEFAULT_ACTIONS: tuple[ActionRow, ...] = (
    ActionRow(
        when=When(min_not_inspected_share=0.3),
        action="CHECK_STATION",
        confidence=0.9,
        text="Many panels were not inspected: see the fault code; the statistics are blind meanwhile",
    ),
    ActionRow(
        when=When(rules=("CUSUM_ABOVE", "EWMA_ABOVE"), min_ratio=4.0),
        action="HOLD",
        confidence=0.9,
        text="Several times the usual defects: hold the line until the cause is found",
    ),
    ActionRow(
        when=When(rules=("REPEATED_PLACE",)),
        action="CHECK_FIXTURE",
        confidence=0.8,
        text="Defects come back at one place: hanger, gun or a drip above it; a mark on lens or lamp is possible too",
    ),
    ActionRow(
        when=When(rules=RISES, spread=("CLUSTERED",)),
        action="CLEAN_BOOTH",
        confidence=0.7,
        text="More defects, in clusters: flakes and fibres that fall off, from walls, conveyor or clothes",
    ),
    ActionRow(
        when=When(rules=("HEIGHT_ABOVE",)),
        action="CHECK_PAINT",
        confidence=0.5,
        text="Seeds are higher than usual: agglomerates in the paint; check its strainer and circulation",
    ),
    ActionRow(
        when=When(rules=("CUSUM_ABOVE", "EWMA_ABOVE"), spread=("RANDOM", "EVEN")),
        action="CHECK_FILTER",
        confidence=0.7,
        text="More defects all over the panel: airborne dust; check supply-air filters and the booth's pressure",
    ),
    ActionRow(
        when=When(rules=("CUSUM_ABOVE", "EWMA_ABOVE")),
        action="CHECK_FILTER",
        confidence=0.5,
        text="More defects for some time, too few on each panel to tell how they lie: airborne dust is likeliest",
    ),
    ActionRow(
        when=When(rules=("COUNT_ABOVE",)),
        action="WATCH",
        confidence=0.6,
        text="One panel with many defects: look at it; the line may be in order",
    ),
    ActionRow(
        when=When(rules=FALLS),
        action="CHECK_LAMP",
        confidence=0.5,
        text="Fewer defects than usual: make sure that lamp and lens still show them, then learn the baseline anew",
    ),
    ActionRow(
        when=When(rules=("HEIGHT_BELOW", "HEIGHT_PATTERN")),
        action="WATCH",
        confidence=0.3,
        text="Heights have changed their pattern: look for a change of material or of the calibration",
    ),
)


def _or_file(schema: dict[str, Any]) -> None:
    """The table may stand in a file of its own: say so in the JSON schema."""
    in_place = {"type": schema.pop("type"), "items": schema.pop("items")}
    schema["anyOf"] = [in_place, {"type": "string", "description": "YAML file with the rows"}]


class StatisticsSettings(Strict):
    """Statistics of the paint loop: when they warn, and what they advise."""

    baseline_panels: int = Field(50, ge=10, le=10000)
    """A recipe's baseline is learnt from so many of its first inspected panels; no alarm before."""
    baseline_defects: int = Field(20, ge=1, le=100000)
    """It waits for so many defects too, for at most four times as many panels."""
    baseline_settled_panels: int = Field(500, ge=0, le=100000)
    """While no alarm stands, later panels refine it until it rests on so many."""
    targets: tuple[Target, ...] = Field((), strict=False)
    """Rates that the plant sets, in place of baselines learnt."""
    limits: Literal["probability", "three_sigma"] = "probability"
    """Limits of the u-chart: exact ones of Poisson's law, or the textbook's mean +/- 3 sigma."""
    tail: float = Field(0.0001, ge=1e-9, le=0.05)
    """With limits probability: how probable a count beyond either limit is while all is well."""
    ewma_weight: float = Field(0.1, gt=0, le=1)
    """Weight of the latest panel in the EWMA."""
    ewma_width: float = Field(3.7, gt=0, le=10)
    """Its limits, in standard deviations of the EWMA."""
    cusum_reference: float = Field(0.5, gt=0, le=5)
    """The CUSUM finds shifts from twice this on soonest, standard deviations of one panel's count."""
    cusum_limit: float = Field(8.0, gt=0, le=100)
    """Its decision interval, in the same unit."""
    cusum_head_start: float = Field(0.5, ge=0, lt=1)
    """Fast initial response: after a reset the sums begin at this share of the limit; 0: at 0."""
    height_group_panels: int = Field(20, ge=1, le=1000)
    """Run rules look at the mean height of so many panels with heights at a time."""
    run_rules: tuple[Annotated[int, Field(ge=1, le=8)], ...] = (1, 2)
    """Nelson's numbers of the run rules on mean height; empty: none."""
    max_height_sigma: PositiveFloat = 0.5
    """A height whose sigma is a larger share of it counts as a defect, not as a height."""
    large_um: PositiveFloat = 500.0
    """A seed is large above this height, um."""
    window_panels: int = Field(50, ge=10, le=500)
    """What is called recent: the last so many panels."""
    significance: float = Field(0.001, ge=1e-9, le=0.05)
    """Trend, spread and repeated places are told apart from chance at this probability of being wrong."""
    alarm_panels: int = Field(5, ge=1, le=1000)
    """An alarm of a single panel stands for so many panels; any other while its chart shows it."""
    actions: tuple[ActionRow, ...] = Field(DEFAULT_ACTIONS, strict=False, json_schema_extra=_or_file)
    """What to advise, the first row whose conditions hold: in place, or a file that has the rows."""

    @model_validator(mode="after")
    def _one_target_each(self) -> Self:
        recipes = [target.recipe for target in self.targets]
        if len(set(recipes)) < len(recipes):
            raise ValueError("two targets for one recipe; allowed: one each, and one with recipe null")
        return self

    def target_of(self, recipe_id: int) -> Target | None:
        """The plant's target for a recipe; None: it is learnt."""
        by_recipe = {target.recipe: target for target in self.targets}
        return by_recipe.get(recipe_id) or by_recipe.get(None)
