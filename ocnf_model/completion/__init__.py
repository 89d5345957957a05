"""Volumetric completion (paper section 4.2): one depth map in, the occupancy of the whole scene out."""
