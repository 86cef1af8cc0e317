"""The bytes of PushBots."""
