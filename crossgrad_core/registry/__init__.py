"""The installed plugins, the slots that they fill, and the way a run calls them."""
