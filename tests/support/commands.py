"""Command lines in this process."""

import pytest

from crossgrad_core.cli.main import main


def ended(*arguments: object) -> int:
    """The exit status of `crossgrad` with these arguments."""
    with pytest.raises(SystemExit) as error:
        main([str(each) for each in arguments])
    return int(error.value.code or 0)
