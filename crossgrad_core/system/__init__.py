"""Services of the operating system: files, signals and terminals."""
