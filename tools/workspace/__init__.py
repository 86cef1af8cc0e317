"""What stands between a clone and a running node: set-up, environment, and the `run` command.

Standard library only, since it runs before anything is installed.
"""
