"""Commands for authors and users of plugins: list, describe, check and create plugins."""
