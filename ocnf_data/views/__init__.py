"""Posed depth: cameras, rigs, noise, the store of rendered views, and readers of scans."""
