"""The recipe of a run: the table of decided settings, and how it is applied and written down."""
