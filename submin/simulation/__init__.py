"""Simulated images, with truth."""
