"""DotBots by PyDotBot."""
