"""`python -m crossgrad_core` is `crossgrad`."""

from crossgrad_core.cli.main import main

main()
