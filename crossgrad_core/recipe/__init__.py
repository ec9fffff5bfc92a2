"""The recipe of a run: the table of decided settings, its application and its storage."""
