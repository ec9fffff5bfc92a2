"""The command line. The modules of the command line import nothing heavy until a command runs."""
