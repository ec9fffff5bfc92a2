"""Networks and activations of the anchors in one differentiable step (CPU, float32).

The plain path keeps a dozen tensors of A x 70 numbers and touches each several times. Here the
second layers run on stretches of anchors that stay in the cache, and what is not drawn is not
written.
"""
