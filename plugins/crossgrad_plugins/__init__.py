"""Samplers, groupings, densifiers, rasterizers, readers and observers that ship with crossgrad."""
