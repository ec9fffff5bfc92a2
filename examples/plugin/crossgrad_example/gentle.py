"""A recipe that changes one decision of another recipe."""

from typing_extensions import override

from crossgrad_core.plugin import Decision, Facts, Recipe, build_component, with_rows


class Gentle(Recipe):
    """Decides like recipe `auto`, but uses the published learning rates."""

    @override
    def decide(self, facts: Facts) -> list[Decision]:
        rows = build_component(Recipe, "auto", {}).decide(facts)
        slow = Decision("rate_factor", 1.0, "published rates", override="--rate-factor F")
        return with_rows(rows, [slow])
