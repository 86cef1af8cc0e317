"""Nodes of PushBots."""
