"""Adam for named tensors, with per-tensor step counts and learning rates."""
