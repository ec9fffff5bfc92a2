"""Adam for named tensors, with per-tensor step counts and learning rates."""

from crossgrad_core.optimizer.adam import adam_step
from crossgrad_core.optimizer.state import AdamState

__all__ = ["AdamState", "adam_step"]
