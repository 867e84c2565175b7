"""Training policies: environments in, policies out."""
