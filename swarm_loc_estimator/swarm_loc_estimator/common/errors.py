"""The base class of users' mistakes."""

from __future__ import annotations


class UserError(ValueError):
    """A mistake of a user, such as a wrong file or parameter; the message is one sentence."""
