"""Everything MuJoCo: the scene is built here, synced here, asked and drawn here."""
