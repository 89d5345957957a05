"""Checking, describing and repairing a data set on disk."""
