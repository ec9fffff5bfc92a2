"""The installed plugins, the slots that they fill, and how a run calls plugins."""
