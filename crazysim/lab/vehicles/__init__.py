"""Controllers and dynamics of cars beyond pure pursuit: LQR and LPV along paths, and CommonRoad's single track."""
