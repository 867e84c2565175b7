"""Identification of fitted dynamics, under the names of Crazyflow 0.4.0."""
