"""The workspace of a clone: set-up, environment, and the `run` command.

It uses the standard library only, since it runs before anything is installed.
"""
