"""The command `crossgrad`, and `python -m crossgrad_core`."""

from crossgrad_core.system.cores import let_idle_threads_sleep
from crossgrad_core.system.interrupts import ended_quietly


def main() -> None:
    """Run the command line; interrupts are also handled while large modules are imported."""
    let_idle_threads_sleep()
    with ended_quietly():
        from crossgrad_core.cli.main import main as command

        command()


if __name__ == "__main__":
    main()
