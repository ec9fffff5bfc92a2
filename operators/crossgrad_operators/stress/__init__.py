"""Tests of every registered operator on extreme gradients, against exact arithmetic."""
