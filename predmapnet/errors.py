"""Errors that users can put right: their message says what is wrong, where, and what to do."""

from collections.abc import Iterator
from contextlib import contextmanager


class UserError(Exception):
    """A mistake or a broken input that the user can put right; shown as one message, without a traceback."""


@contextmanager
def value_errors_told() -> Iterator[None]:
    """Raise the ValueErrors of :mod:`mapfusion`, whose messages are written for users, as UserErrors."""
    try:
        yield
    except ValueError as error:
        raise UserError(str(error)) from error
