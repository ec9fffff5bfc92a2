"""`crossgrad sweep`: runs of configurations x scenes x seeds, on a machine or a cluster."""
