"""Faults of running trainings and of their folders."""
