"""The command line. These modules import no large package until a command runs."""
