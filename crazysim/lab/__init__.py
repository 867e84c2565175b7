"""The laboratory: live loops with real vehicles, shows, identification from logs, and validation."""
