"""Command line of PredMapNet: one file per command, no logic that a script would miss."""
