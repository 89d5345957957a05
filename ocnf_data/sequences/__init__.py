"""Scans as data sets: which frames there are, which go into which input, and the cube that is fused.

The paper's experiment on Kinect scans (section 4.1): all frames of a scan give the reference, and each of N
configurations is a random subset of 10 or 20 of them. Nothing here knows of manifests or samples.
"""

Box = tuple[float, float, float, float, float, float]
"""x0 y0 z0 x1 y1 z1 in metres, in the scan's coordinates."""
