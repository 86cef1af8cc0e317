"""What all simulated worlds share: motion, sensors, errors, transport."""
