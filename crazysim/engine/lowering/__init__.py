"""Lowering: from the stages of a pipeline, by their jaxprs, to a program of scalar operations."""
