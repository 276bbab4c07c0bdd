"""What a user can get wrong: one exception type whose message says what, where, and what to do about it."""


class UserError(Exception):
    """A mistake or a broken input that the user can put right; shown as one message, without a traceback."""
