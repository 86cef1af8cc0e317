"""PushBots: event tracker, calibration, driver, and the maps that they make."""
