"""The MuJoCo scene: building, syncing, querying and rendering it."""
