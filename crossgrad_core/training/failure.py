"""Errors of a training step."""


class NonFiniteError(Exception):
    """A loss, gradient or parameter is NaN or infinite.

    Args:
        step: Step in which it was found.
        views: Names of the views of that step (the one view, where it can be told).
        block: What is not finite.
    """

    def __init__(self, step: int, views: tuple[str, ...], block: str) -> None:
        self.step = step
        self.views = views
        self.block = block
        super().__init__(
            f"{block} is not finite in step {step}, view{'s' if len(views) > 1 else ''} "
            f"{', '.join(views)}"
        )


class TrainingFailedError(Exception):
    """Training cannot go on; the results so far and the last checkpoint are kept."""
