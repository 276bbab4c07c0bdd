"""The shipped checkpoint and what reads it."""
