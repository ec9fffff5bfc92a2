"""`crossgrad plan` and `--plan`: decisions about the settings of a run, with their evidence."""
