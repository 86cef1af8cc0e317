"""One file per sensor: from messages to measurements."""
