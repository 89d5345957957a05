"""Posed depth frames into a mesh."""
