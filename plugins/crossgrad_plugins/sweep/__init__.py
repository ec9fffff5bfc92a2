"""`crossgrad sweep`: configurations x scenes x seeds, on the cores of a machine or of a cluster."""
