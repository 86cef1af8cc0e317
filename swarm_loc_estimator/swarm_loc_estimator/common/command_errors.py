"""End a command with a status: its own, or one sentence for a mistake of the user, or that of Ctrl-C."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec

from swarm_loc_estimator.common.errors import UserError

Arguments = ParamSpec("Arguments")

_INTERRUPTED = 130
"""What shells say of a program that SIGINT has ended."""


def exit_with_message(main: Callable[Arguments, int]) -> Callable[Arguments, int]:
    """For a command's main: mistakes and files that cannot be used end it with a sentence and status 1."""

    @wraps(main)
    def wrapped(*args: Arguments.args, **kwargs: Arguments.kwargs) -> int:
        try:
            return main(*args, **kwargs)
        except UserError as error:
            message = str(error)
        except OSError as error:
            message = f"{error.filename or 'A file'} cannot be used: {error.strerror or error}."
        except KeyboardInterrupt:
            return _INTERRUPTED
        print(message, file=sys.stderr)
        return 1

    return wrapped
