"""The fused update of Adam."""
