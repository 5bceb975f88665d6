"""Errors that a person can act on; the command line prints one line and exits with their code."""

import difflib
from collections.abc import Iterable


class RtcError(Exception):
    """Something went wrong that the message explains.

    `message` states the value given and the rule it breaks; `hint` says what to change.
    `exit_code` replaces the class's code where a single error needs another one.
    """

    default_exit_code = 1

    def __init__(self, message: str, hint: str = "", exit_code: int | None = None) -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint
        self.exit_code = self.default_exit_code if exit_code is None else exit_code

    def __reduce__(self) -> tuple[type["RtcError"], tuple[str, str, int]]:
        # Worker processes send their errors to the parent; keep hint and code on the way.
        return type(self), (self.message, self.hint, self.exit_code)


class UsageError(RtcError):
    """What the user typed cannot be used: options, recipe, names, geometry (exit 2)."""

    default_exit_code = 2


class StateError(RtcError):
    """What lies on disk or elsewhere cannot be used: run, checkpoint, data, full disk (exit 3)."""

    default_exit_code = 3


class DivergedError(RtcError):
    """A computation produced NaN or infinity (exit 4)."""

    default_exit_code = 4


class PartialResult(RtcError):
    """Some of what was asked for is done and kept, some is not (exit 5)."""

    default_exit_code = 5


def did_you_mean(name: str, allowed: Iterable[str]) -> str:
    """Return ' Did you mean "x"? Allowed: a, b, c.', the question only where something is close."""
    names = [str(candidate) for candidate in allowed]
    close = difflib.get_close_matches(str(name), names, n=1, cutoff=0.6)
    question = f' Did you mean "{close[0]}"?' if close else ""
    return f"{question} Allowed: {', '.join(names) if names else 'nothing'}."
