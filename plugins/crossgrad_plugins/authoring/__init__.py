"""For authors and users of plugins: lists, explanations, contract checks, new packages."""
