"""`crossgrad sweep`: runs of configurations x scenes x seeds, on one machine or on a cluster."""
