"""Ctrl-C for commands that a test starts."""

import signal


def heed_interrupts() -> None:
    """Undo what a shell does to commands in the background: they would not hear Ctrl-C. To run before the command."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
