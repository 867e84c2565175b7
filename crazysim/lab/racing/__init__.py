"""Racing: time-optimal plans, the race clock, and flights over a track."""
