"""Exports of steps and policies to other systems."""
