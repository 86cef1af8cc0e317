"""Range, bearing and heading from infrared brightness matrices: what every sensor reads of every emitter."""
