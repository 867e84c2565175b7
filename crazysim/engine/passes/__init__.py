"""Passes: functions from a program to an equivalent program that takes less time."""
