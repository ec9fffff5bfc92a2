"""The slots: one file for the base class of each kind of component."""
