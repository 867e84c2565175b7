"""Passes: functions from a program to an equivalent one that takes less time."""
