"""The fit of gains of infrared sensors and emitters."""
