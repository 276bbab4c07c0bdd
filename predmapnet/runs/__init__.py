"""Runs behind the commands: infer, batch, evaluate and integrate as functions."""
