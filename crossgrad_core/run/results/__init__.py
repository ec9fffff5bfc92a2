"""What a run leaves on disk and shows at its end: folder, tables, curve, panels, log."""
