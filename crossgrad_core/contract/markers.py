"""The marks of hook specifications and implementations."""

import pluggy

PROJECT = "crossgrad"


hookspec = pluggy.HookspecMarker(PROJECT)


hookimpl = pluggy.HookimplMarker(PROJECT)
