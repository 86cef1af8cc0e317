"""Simulated PushBots: floor plans, their motion, and what they measure."""
