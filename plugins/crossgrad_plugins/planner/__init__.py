"""`crossgrad plan` and `--plan`: decisions on the settings of a run, with verifiable evidence."""
