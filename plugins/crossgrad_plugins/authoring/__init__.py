"""Commands for authors and users of plugins: lists, descriptions, contract checks, new packages."""
