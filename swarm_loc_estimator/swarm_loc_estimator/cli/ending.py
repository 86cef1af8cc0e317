"""How commands end: their work done, with one sentence on what is wrong, or by Ctrl-C."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec

Arguments = ParamSpec("Arguments")

_INTERRUPTED = 130
"""What shells say of a program that SIGINT has ended."""


def told_in_a_sentence(
    *mistakes: type[Exception],
) -> Callable[[Callable[Arguments, int]], Callable[Arguments, int]]:
    """For a command's main: mistakes, and files that cannot be used, end it with one sentence and status 1.

    Args:
        mistakes: Errors whose message is one sentence for the user.
    """

    def around(main: Callable[Arguments, int]) -> Callable[Arguments, int]:
        @wraps(main)
        def ending(*args: Arguments.args, **kwargs: Arguments.kwargs) -> int:
            try:
                return main(*args, **kwargs)
            except mistakes as error:
                print(error, file=sys.stderr)
                return 1
            except OSError as error:
                print(
                    f"{error.filename or 'A file'} cannot be used: {error.strerror or error}.",
                    file=sys.stderr,
                )
                return 1
            except KeyboardInterrupt:
                return _INTERRUPTED

        return ending

    return around
