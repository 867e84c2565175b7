"""What a simulation is made of: records, stages, pipelines, integrators, random numbers and settings."""
