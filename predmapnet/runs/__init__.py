"""The run behind each command, without the command line."""
