"""Results of a run on disk and on screen: folder, tables, curve, panels, log."""
