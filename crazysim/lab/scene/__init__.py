"""Maps and Gaussian splats: files of scanned surroundings as boxes, and as images."""
